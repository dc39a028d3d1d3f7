// SPDX-License-Identifier: GPL-3.0-or-later
// The unmodified program in libsimavr's ATmega2560. Timers 1 and 4, the ADC and UART0 are modelled here, after the
// data sheet, because simavr 1.6 has no phase-correct PWM, clips differential conversions, clears every timer flag on a
// write, and does not overrun its receiver. Page numbers are of Atmel 2549Q.
#include "board.h"

#include <math.h>
#include <simavr/avr_adc.h>
#include <simavr/avr_timer.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_interrupts.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { // data addresses
    PINA = 0x20, DDRA = 0x21, PORTA = 0x22, DDRB = 0x24, PORTB = 0x25, TIFR1 = 0x36, TIFR4 = 0x39, GTCCR = 0x43,
    MCUSR = 0x54, TIMSK1 = 0x6F, TIMSK4 = 0x72, ADCL = 0x78, ADCH = 0x79, ADCSRA = 0x7A, ADCSRB = 0x7B, ADMUX = 0x7C,
    TCCR1A = 0x80, TCCR1B = 0x81, TCNT1L = 0x84, OCR1AL = 0x88, OCR1BL = 0x8A, TCCR4A = 0xA0, TCCR4B = 0xA1,
    TCNT4L = 0xA4, ICR4L = 0xA6, UCSR0A = 0xC0, UCSR0B = 0xC1, UBRR0L = 0xC4, UBRR0H = 0xC5, UDR0 = 0xC6,
    DDRH = 0x101, PORTH = 0x102,
};

#define BYTE_CYCLES (10u * 8u * 4u) // on the host's side of the line: 500000 baud
#define LINE 65536u                 // bytes that it holds
#define INTERRUPT_ENTRY 5           // cycles, p. 16: simavr takes none
#define SETTLING 2000u              // cycles: 125 us, p. 275
#define PAINT 0xC5

struct line {
    uint8_t bytes[LINE];
    uint64_t times[LINE];
    uint32_t in, out;
};

struct board {
    avr_t *avr;
    avr_io_t io; // reports resets
    avr_timer_t *timer1, *timer4;
    avr_uart_t *uart;
    avr_adc_t *adc;
    struct pins pins;
    struct outcome outcome;
    struct load load;
    struct { uint8_t vector; uint64_t since; } running[8]; // interrupts, one within the other
    uint8_t depth;
    uint64_t rx_since; // when the receiver's interrupt was raised
    bool resetting; // by board_reset, not the watchdog

    // Timer1
    bool dual, rising, period_over;
    uint32_t top, half; // cycles from BOTTOM to TOP
    uint64_t bottom;    // the last one, or the next when counting down
    uint64_t latched;   // when the period ended
    uint8_t acting;     // OCR1A after the double buffer

    // Timer4
    bool counting;
    uint64_t count_base; // cycle at which it was 0

    const uint32_t *edges;
    uint32_t edge_count, edge;
    uint64_t edges_from;

    // ADC
    bool converting, first;
    uint64_t selected;      // since when the channel has been chosen
    uint64_t started;
    double before, held;    // V of the channel chosen before this one, and of this one
    uint8_t mux;            // latched
    uint16_t result;

    // UART0
    struct line to_board, from_board;
    bool to_board_moving, rx_blocked;
    uint8_t fifo[3], fifo_length; // the two of the chip and its shift register
    bool sending, tx_full;
    uint8_t shifting, tx_byte;

    // AS5040
    uint16_t ssi_word;
    int8_t ssi_bit; // that the last rising edge brought out; -1: none yet
    uint64_t ssi_edge;

    // hang
    bool hanging;
    uint32_t hang_at;
    uint8_t hang_code[2];
};

static uint8_t *reg(struct board *b, uint16_t address) {
    return &b->avr->data[address];
}

static uint16_t reg16(struct board *b, uint16_t address) {
    return (uint16_t)(*reg(b, address) | *reg(b, address + 1) << 8);
}

static void set16(struct board *b, uint16_t address, uint16_t value) {
    *reg(b, address) = (uint8_t)value;
    *reg(b, address + 1) = (uint8_t)(value >> 8);
}

static void clear_flag(struct board *b, avr_int_vector_t *vector) {
    vector->pending = 0;
    avr_regbit_clear(b->avr, vector->raised);
}

// --- Timers 1 and 4 --------------------------------------------------------------------------------------------------

static const uint32_t PRESCALER[8] = {0, 1, 8, 64, 256, 1024, 0, 0};

static avr_cycle_count_t timer1_event(avr_t *avr, avr_cycle_count_t when, void *param) {
    struct board *b = param;
    (void)avr;
    if (b->dual && b->rising) { // at TOP: p. 147, update of OCR1A
        b->rising = false;
        b->bottom = when + b->half;
    } else {
        if (!b->dual)
            b->half = (b->top + 1) * PRESCALER[*reg(b, TCCR1B) & 7];
        b->rising = true;
        b->bottom = when;
        avr_raise_interrupt(b->avr, &b->timer1->overflow);
        if (b->dual)
            return when + b->half;
    }
    b->acting = *reg(b, OCR1AL);
    b->latched = when;
    b->period_over = true;
    if (reg16(b, OCR1BL) == b->top)
        avr_raise_interrupt(b->avr, &b->timer1->comp[1].interrupt);
    return when + b->half;
}

static void timer1_start(struct board *b) {
    const uint8_t mode = (*reg(b, TCCR1A) & 3) | (*reg(b, TCCR1B) >> 1 & 0xC);
    const uint32_t divider = PRESCALER[*reg(b, TCCR1B) & 7];
    static const uint32_t TOPS[8] = {65535, 255, 511, 1023, 0, 255, 511, 1023}; // p. 145; CTC and the rest: not here
    avr_cycle_timer_cancel(b->avr, timer1_event, b);
    b->top = mode < 8 ? TOPS[mode] : 0;
    b->dual = mode >= 1 && mode <= 3;
    b->half = 0;
    if (divider == 0 || b->top == 0 || (*reg(b, GTCCR) & 0x81) == 0x81)
        return;
    b->half = (b->dual ? b->top : b->top + 1) * divider;
    b->rising = true;
    b->bottom = b->avr->cycle;
    avr_cycle_timer_register(b->avr, b->half, timer1_event, b);
}

static avr_cycle_count_t timer4_overflow(avr_t *avr, avr_cycle_count_t when, void *param) {
    struct board *b = param;
    (void)avr;
    avr_raise_interrupt(b->avr, &b->timer4->overflow);
    return when + 8 * 65536;
}

static void timer4_start(struct board *b) {
    avr_cycle_timer_cancel(b->avr, timer4_overflow, b);
    b->counting = (*reg(b, TCCR4B) & 0x1F) == 2 && (*reg(b, TCCR4A) & 3) == 0 && (*reg(b, GTCCR) & 0x81) != 0x81;
    if (!b->counting) // normal mode, prescaler 8, or it stands still
        return;
    b->count_base = b->avr->cycle;
    avr_cycle_timer_register(b->avr, 8 * 65536, timer4_overflow, b);
}

static avr_cycle_count_t ir_edge(avr_t *avr, avr_cycle_count_t when, void *param) {
    struct board *b = param;
    (void)avr, (void)when;
    const uint64_t at = b->edges_from + b->edges[b->edge++];
    if (b->counting && *reg(b, TCCR4B) & 0x40) {
        set16(b, ICR4L, (uint16_t)((at - b->count_base) / 8));
        avr_raise_interrupt(b->avr, &b->timer4->icr);
    }
    return b->edge < b->edge_count ? b->edges_from + b->edges[b->edge] : 0;
}

static void write_timer1(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct board *b = param;
    const uint8_t old = avr->data[address];
    avr->data[address] = value;
    const uint8_t matters = address == TCCR1A ? 0x03 : 0x1F; // WGM and CS
    if ((old ^ value) & matters)
        timer1_start(b);
}

static void write_timer4(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct board *b = param;
    const uint8_t old = avr->data[address];
    avr->data[address] = value;
    const uint8_t matters = address == TCCR4A ? 0x03 : 0x1F;
    if ((old ^ value) & matters)
        timer4_start(b);
}

static void write_prescaler(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    const bool held = (avr->data[address] & 0x81) == 0x81;
    avr->data[address] = value & 0x80 ? value : 0; // PSRSYNC stays only while TSM holds it, p. 165
    if (held && !(value & 0x80)) {
        timer1_start(param);
        timer4_start(param);
    }
}

static uint8_t read_count(avr_t *avr, avr_io_addr_t address, void *param) {
    struct board *b = param;
    if (address == TCNT4L && b->counting)
        set16(b, TCNT4L, (uint16_t)((avr->cycle - b->count_base) / 8));
    if (address == TCNT1L && b->half) {
        const uint64_t away = avr->cycle > b->bottom ? avr->cycle - b->bottom : b->bottom - avr->cycle;
        set16(b, TCNT1L, (uint16_t)(away / PRESCALER[*reg(b, TCCR1B) & 7]));
    }
    return avr->data[address];
}

static void write_ignored(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    (void)param;
    avr->data[address] = value;
}

static void write_duty(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct board *b = param;
    if (avr->data[address] != value)
        b->outcome.written = avr->cycle;
    avr->data[address] = value;
}

static void write_flags(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct board *b = param;
    avr_timer_t *timer = address == TIFR1 ? b->timer1 : b->timer4;
    (void)avr;
    if (value & 0x01)
        clear_flag(b, &timer->overflow);
    if (value & 0x04)
        clear_flag(b, &timer->comp[1].interrupt);
    if (value & 0x20)
        clear_flag(b, &timer->icr);
}

// Whether the PWM pin is high: it is below OCR1A, on both slopes.
static bool pulse_high(struct board *b, uint64_t now) {
    const uint64_t away = now > b->bottom ? now - b->bottom : b->bottom - now;
    return b->outcome.running && away < (uint64_t)b->acting * PRESCALER[*reg(b, TCCR1B) & 7];
}

// Input of the H-bridge: the pin driven by OC1A, forwards, not braked.
static uint8_t duty(struct board *b) {
    const bool driven = (*reg(b, TCCR1A) & 0xC0) == 0x80 && *reg(b, DDRB) & 0x20;
    const bool forwards = *reg(b, DDRB) & *reg(b, PORTB) & 0x40;
    const bool braked = !(*reg(b, DDRH) & 0x40) || *reg(b, PORTH) & 0x40;
    return driven && forwards && !braked ? b->acting : 0;
}

// --- ADC -------------------------------------------------------------------------------------------------------------

static double channel(struct board *b, uint8_t mux, uint64_t now) {
    switch (mux) {
    case 0x00: return pulse_high(b, now) ? b->pins.current : 0.0;
    case 0x01: return b->pins.negative;
    case 0x02: return b->pins.angle;
    case 0x03: return b->pins.positive;
    case 0x13: return b->pins.positive - b->pins.negative;
    default: return 0.0;
    }
}

static uint8_t selected_mux(struct board *b) {
    return (*reg(b, ADMUX) & 0x1F) | (*reg(b, ADCSRB) & 0x08) << 2;
}

static double reference(struct board *b) {
    static const double VOLTS[4] = {5.0, 5.0, 1.1, 2.56}; // p. 281; AREF is not wired
    return VOLTS[*reg(b, ADMUX) >> 6];
}

static avr_cycle_count_t adc_done(avr_t *avr, avr_cycle_count_t when, void *param) {
    struct board *b = param;
    (void)when;
    set16(b, ADCL, b->result);
    b->converting = false;
    avr->data[ADCSRA] &= ~0x40;
    avr_raise_interrupt(avr, &b->adc->adc);
    return 0;
}

static avr_cycle_count_t adc_sample(avr_t *avr, avr_cycle_count_t when, void *param) {
    struct board *b = param;
    (void)avr;
    const bool differential = b->mux >= 0x08;
    double volts = channel(b, b->mux, when);
    // p. 275: results of conversions started within 125 us after the selection of a differential channel must be
    // discarded. Here they contain a part of the earlier value of the stage: half of it at once, 2 % after 107 us.
    if (differential && b->started < b->selected + SETTLING)
        volts += (b->before - volts) * exp2(-1.0 - (double)(b->started - b->selected) / 400.0);
    b->held = volts;
    const double full = differential ? 512.0 : 1024.0;
    const double low = differential ? -512.0 : 0.0;
    const double counts = floor(volts / reference(b) * full + 0.5);
    const double limited = counts < low ? low : counts > low + 1023.0 ? low + 1023.0 : counts;
    b->result = (uint16_t)((int)limited & 0x3FF);
    return 0;
}

static void write_adcsra(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct board *b = param;
    const uint8_t old = avr->data[address];
    if (value & 0x10)
        clear_flag(b, &b->adc->adc);
    avr->data[address] = (value & ~0x50) | (avr->data[address] & 0x10) | (b->converting ? 0x40 : 0);
    if (!(old & 0x80) && value & 0x80)
        b->first = true;
    if (b->converting || (value & 0xC0) != 0xC0)
        return;
    const uint32_t divider = value & 7 ? 1u << (value & 7) : 2;
    b->converting = true;
    b->started = avr->cycle;
    b->mux = selected_mux(b);
    avr->data[address] |= 0x40;
    // p. 274: held after 1.5 clocks of 13, in the first conversion after 13.5 of 25
    avr_cycle_timer_register(avr, (b->first ? 27 : 3) * divider / 2, adc_sample, b);
    avr_cycle_timer_register(avr, (b->first ? 25 : 13) * divider, adc_done, b);
    b->first = false;
}

static void write_mux(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct board *b = param;
    if (avr->data[address] != value) {
        b->before = b->held;
        b->selected = avr->cycle;
    }
    avr->data[address] = value;
}

// --- UART0 -----------------------------------------------------------------------------------------------------------

static bool in_tune(struct board *b) {
    const uint32_t divider = ((*reg(b, UBRR0H) & 0xF) << 8 | *reg(b, UBRR0L)) + 1u;
    return divider * (*reg(b, UCSR0A) & 2 ? 8 : 16) * 10 == BYTE_CYCLES;
}

static avr_cycle_count_t rx_byte(avr_t *avr, avr_cycle_count_t when, void *param) {
    struct board *b = param;
    struct line *line = &b->to_board;
    const uint8_t byte = line->bytes[line->out++ % LINE] ^ (in_tune(b) ? 0 : 0x55);
    if (avr->data[UCSR0B] & 0x10) {
        if (b->rx_blocked) { // p. 219: both places and the shift register were full when it began
            avr->data[UCSR0A] |= 0x08;
            b->outcome.overruns++;
        } else {
            if (b->fifo_length == 0)
                b->rx_since = when;
            b->fifo[b->fifo_length++] = byte;
            avr_raise_interrupt(avr, &b->uart->rxc);
        }
    }
    b->rx_blocked = b->fifo_length == 3;
    b->to_board_moving = line->out != line->in;
    return b->to_board_moving ? when + BYTE_CYCLES : 0;
}

static void to_wire(struct board *b, uint8_t byte, uint64_t when) {
    struct line *line = &b->from_board;
    if (line->in - line->out == LINE)
        line->out++;
    line->bytes[line->in % LINE] = byte ^ (in_tune(b) ? 0 : 0x55);
    line->times[line->in++ % LINE] = when;
}

static avr_cycle_count_t tx_byte(avr_t *avr, avr_cycle_count_t when, void *param) {
    struct board *b = param;
    to_wire(b, b->shifting, when);
    b->sending = b->tx_full;
    if (!b->tx_full) {
        avr_raise_interrupt(avr, &b->uart->txc);
        return 0;
    }
    b->shifting = b->tx_byte;
    b->tx_full = false;
    avr_raise_interrupt(avr, &b->uart->udrc);
    return when + BYTE_CYCLES;
}

static uint8_t read_udr(avr_t *avr, avr_io_addr_t address, void *param) {
    struct board *b = param;
    (void)address;
    if (b->fifo_length == 0)
        return 0;
    const uint8_t byte = b->fifo[0];
    memmove(b->fifo, b->fifo + 1, --b->fifo_length);
    avr->data[UCSR0A] &= ~0x08;
    clear_flag(b, &b->uart->rxc);
    if (b->fifo_length) {
        b->rx_since = avr->cycle;
        avr_raise_interrupt(avr, &b->uart->rxc);
    }
    return byte;
}

static void write_udr(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct board *b = param;
    (void)address;
    if (!(avr->data[UCSR0B] & 0x08) || b->tx_full)
        return;
    if (b->sending) {
        b->tx_byte = value;
        b->tx_full = true;
        clear_flag(b, &b->uart->udrc);
        return;
    }
    b->shifting = value;
    b->sending = true;
    avr_cycle_timer_register(avr, BYTE_CYCLES, tx_byte, b);
    avr_raise_interrupt(avr, &b->uart->udrc); // its place is free again
}

static void write_ucsra(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct board *b = param;
    if (value & 0x40)
        clear_flag(b, &b->uart->txc);
    avr->data[address] = (avr->data[address] & 0xFC) | (value & 0x03);
}

static void write_ucsrb(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct board *b = param;
    avr->data[address] = value;
    if (!b->tx_full && value & 0x08)
        avr_raise_interrupt(avr, &b->uart->udrc);
    if (b->fifo_length && value & 0x10)
        avr_raise_interrupt(avr, &b->uart->rxc);
}

static uint8_t read_plain(avr_t *avr, avr_io_addr_t address, void *param) {
    (void)param;
    return avr->data[address];
}

// --- AS5040 ----------------------------------------------------------------------------------------------------------

static uint16_t as5040_word(const struct pins *pins) {
    uint16_t word = (uint16_t)((pins->position & 0x3FF) << 6 | (pins->status & 0x1F) << 1);
    return word | ((__builtin_popcount(word) & 1) ^ (pins->parity_error & 1));
}

// Data sheet 1.6, p. 11: CSn low, 500 ns, the first falling edge latches, each rising edge outputs a bit 375 ns later;
// the clock is at most 1 MHz.
static void write_porta(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param) {
    struct board *b = param;
    const uint8_t changed = avr->data[address] ^ value;
    avr->data[address] = value;
    if (!(changed & 0x03))
        return;
    if (avr->cycle - b->ssi_edge < 8)
        b->outcome.ssi_faults++;
    b->ssi_edge = avr->cycle;
    if (changed & 0x01) { // CSn
        b->ssi_bit = -1;
    } else if (!(value & 0x01)) {
        if (!(value & 0x02) && b->ssi_bit < 0)
            b->ssi_word = as5040_word(&b->pins);
        if (value & 0x02 && b->ssi_bit < 16)
            b->ssi_bit++;
    }
}

static uint8_t read_pina(avr_t *avr, avr_io_addr_t address, void *param) {
    struct board *b = param;
    (void)address;
    bool bit = true;
    if (!(avr->data[PORTA] & 0x01) && b->ssi_bit >= 0) {
        const int8_t at = avr->cycle - b->ssi_edge < 6 ? b->ssi_bit - 1 : b->ssi_bit;
        bit = at < 0 || at > 15 || b->ssi_word >> (15 - at) & 1;
    }
    return (avr->data[PORTA] & ~0x04) | (bit ? 0x04 : 0);
}

// --- the board -------------------------------------------------------------------------------------------------------

static void on_reset(avr_io_t *io) {
    struct board *b = (struct board *)((char *)io - offsetof(struct board, io));
    b->avr->run_cycle_limit = 100; // simavr resets it to 1, which is slow
    b->outcome.running = 0;
    b->acting = 0;
    b->half = 0;
    b->counting = b->converting = b->sending = b->tx_full = b->rx_blocked = false;
    b->fifo_length = 0;
    b->to_board_moving = false;
    b->to_board.out = b->to_board.in;
    b->edge = b->edge_count;
    b->depth = 0;
    if (b->hanging)
        memcpy(b->avr->flash + b->hang_at, b->hang_code, 2);
    b->hanging = false;
    if (!b->resetting)
        b->outcome.resets++;
}

static void on_interrupt(avr_irq_t *irq, uint32_t vector, void *param) {
    struct board *b = param;
    const uint64_t now = b->avr->cycle;
    (void)irq;
    if (b->avr->interrupts.running_ptr == b->depth) { // simavr reports before it counts an interrupt in, and after it counts it out
        if (b->depth < 8)
            b->running[b->depth++] = (typeof(b->running[0])){(uint8_t)vector, now};
        const uint32_t waited = (uint32_t)(now - b->rx_since) + INTERRUPT_ENTRY;
        if (vector == b->uart->rxc.vector && waited > b->load.receiver_waited)
            b->load.receiver_waited = waited;
        return;
    }
    const uint32_t took = (uint32_t)(now - b->running[--b->depth].since) + INTERRUPT_ENTRY;
    uint32_t *longest = &b->load.longest_of[b->running[b->depth].vector & 63];
    if (took > *longest)
        *longest = took;
    if (took > b->load.longest)
        b->load.longest = took;
    if (b->depth == 0)
        b->load.cycles += took;
}

static void no_sleep(avr_t *avr, avr_cycle_count_t cycles) {
    (void)avr, (void)cycles; // simulated time costs no wall time
}

static void quiet(avr_t *avr, const int level, const char *format, va_list arguments) {
    (void)avr;
    if (level <= LOG_ERROR)
        vfprintf(stderr, format, arguments);
}

static void on_read(struct board *b, uint16_t address, avr_io_read_t call) {
    b->avr->io[AVR_DATA_TO_IO(address)].r.c = call;
    b->avr->io[AVR_DATA_TO_IO(address)].r.param = b;
}

static void on_write(struct board *b, uint16_t address, avr_io_write_t call) {
    b->avr->io[AVR_DATA_TO_IO(address)].w.c = call;
    b->avr->io[AVR_DATA_TO_IO(address)].w.param = b;
}

struct board *board_new(const char *elf) {
    elf_firmware_t program = {0};
    avr_global_logger_set(quiet);
    if (elf_read_firmware(elf, &program) != 0) {
        fprintf(stderr, "board: cannot read the program %s\n", elf);
        return NULL;
    }
    avr_t *avr = avr_make_mcu_by_name("atmega2560");
    if (avr == NULL)
        return NULL;
    struct board *b = calloc(1, sizeof *b);
    b->avr = avr;
    avr_init(avr);
    avr->sleep = no_sleep;
    avr->frequency = program.frequency = CLOCK_HZ;
    memset(avr->data + avr->ioend + 1, PAINT, avr->ramend - avr->ioend);
    avr_load_firmware(avr, &program);

    for (avr_io_t *io = avr->io_port; io; io = io->next) {
        if (strcmp(io->kind, "timer") == 0 && ((avr_timer_t *)io)->name == '1')
            b->timer1 = (avr_timer_t *)io;
        if (strcmp(io->kind, "timer") == 0 && ((avr_timer_t *)io)->name == '4')
            b->timer4 = (avr_timer_t *)io;
        if (strcmp(io->kind, "uart") == 0 && ((avr_uart_t *)io)->name == '0')
            b->uart = (avr_uart_t *)io;
        if (strcmp(io->kind, "adc") == 0)
            b->adc = (avr_adc_t *)io;
    }
    b->io.kind = "board";
    b->io.reset = on_reset;
    avr_register_io(avr, &b->io);
    avr_irq_register_notify(avr_get_interrupt_irq(avr, AVR_INT_ANY) + AVR_INT_IRQ_RUNNING, on_interrupt, b);

    on_write(b, TCCR1A, write_timer1), on_write(b, TCCR1B, write_timer1);
    on_write(b, TCCR4A, write_timer4), on_write(b, TCCR4B, write_timer4);
    for (uint16_t address = 0; address < 2; address++) {
        on_write(b, TCNT1L + address, write_ignored), on_write(b, TCNT4L + address, write_ignored);
        on_write(b, OCR1AL + address, write_ignored), on_write(b, OCR1BL + address, write_ignored);
        on_read(b, TCNT1L + address, read_count), on_read(b, TCNT4L + address, read_count);
        on_read(b, ADCL + address, read_plain);
        on_write(b, UBRR0L + address, write_ignored);
    }
    on_write(b, OCR1AL, write_duty);
    on_write(b, GTCCR, write_prescaler);
    on_write(b, TIFR1, write_flags), on_write(b, TIFR4, write_flags);
    on_write(b, ADCSRA, write_adcsra), on_write(b, ADCSRB, write_mux), on_write(b, ADMUX, write_mux);
    on_write(b, UCSR0A, write_ucsra), on_write(b, UCSR0B, write_ucsrb), on_write(b, UDR0, write_udr);
    on_read(b, UCSR0A, read_plain), on_read(b, UDR0, read_udr);
    on_write(b, PORTA, write_porta), on_read(b, PINA, read_pina);
    board_reset(b, POWER_ON);
    return b;
}

void board_free(struct board *b) {
    avr_terminate(b->avr);
    free(b->avr);
    free(b);
}

int board_run(struct board *b, const struct pins *pins, uint32_t periods, const uint32_t *edges, uint32_t count,
              struct outcome *outcome) {
    const uint64_t start = b->outcome.running ? b->latched : b->avr->cycle;
    b->pins = *pins;
    b->edges = edges;
    b->edge_count = count;
    b->edge = 0;
    b->edges_from = start;
    if (count) {
        const uint64_t at = start + edges[0];
        avr_cycle_timer_register(b->avr, at > b->avr->cycle ? at - b->avr->cycle : 1, ir_edge, b);
    }
    int state = cpu_Running;
    uint64_t end = start;
    while (periods-- && state != cpu_Done && state != cpu_Crashed) {
        const uint64_t limit = end + PERIOD_CYCLES + 1000; // a running timer ends the period before this
        b->period_over = false;
        while (!b->period_over && b->avr->cycle < limit && state != cpu_Done && state != cpu_Crashed)
            state = avr_run(b->avr);
        b->outcome.running = b->period_over;
        end = b->period_over ? b->latched : b->avr->cycle;
    }
    avr_cycle_timer_cancel(b->avr, ir_edge, b);
    b->outcome.start = start;
    b->outcome.cycles = (uint32_t)(end - start);
    b->outcome.duty = b->outcome.running ? duty(b) : 0;
    *outcome = b->outcome;
    return state == cpu_Done || state == cpu_Crashed ? -1 : 0;
}

uint32_t board_send(struct board *b, const uint8_t *bytes, uint32_t count, uint32_t delay) {
    struct line *line = &b->to_board;
    uint32_t sent = 0;
    for (; sent < count && line->in - line->out < LINE; sent++)
        line->bytes[line->in++ % LINE] = bytes[sent];
    if (sent && !b->to_board_moving) {
        b->to_board_moving = true;
        b->rx_blocked = b->fifo_length == 3;
        avr_cycle_timer_register(b->avr, delay + BYTE_CYCLES, rx_byte, b);
    }
    return sent;
}

uint32_t board_receive(struct board *b, uint8_t *bytes, uint64_t *times, uint32_t room) {
    struct line *line = &b->from_board;
    uint32_t taken = 0;
    for (; taken < room && line->out != line->in; taken++, line->out++) {
        bytes[taken] = line->bytes[line->out % LINE];
        if (times)
            times[taken] = line->times[line->out % LINE];
    }
    return taken;
}

void board_reset(struct board *b, enum cause cause) {
    b->resetting = true;
    avr_reset(b->avr);
    b->resetting = false;
    *reg(b, MCUSR) = (uint8_t)cause;
}

void board_hang(struct board *b) {
    static const uint8_t JUMP_HERE[2] = {0xFF, 0xCF};
    if (b->hanging)
        return;
    b->hanging = true;
    b->hang_at = b->avr->pc;
    memcpy(b->hang_code, b->avr->flash + b->hang_at, 2);
    memcpy(b->avr->flash + b->hang_at, JUMP_HERE, 2);
    b->avr->state = cpu_Running;
}

uint64_t board_next_overflow(const struct board *b) {
    const uint64_t length = 8 * 65536, since = b->avr->cycle - b->count_base;
    return b->count_base + (since / length + 1) * length;
}

uint64_t board_cycle(const struct board *b) {
    return b->outcome.running ? b->latched : b->avr->cycle;
}

uint8_t board_duty_register(const struct board *b) {
    return b->avr->data[OCR1AL];
}

void board_load(const struct board *b, struct load *load) {
    *load = b->load;
    const avr_t *avr = b->avr;
    uint32_t at = avr->ramend, lowest = avr->ramend + 1; // the stack ends where 64 bytes are as painted
    for (uint32_t same = 0; at > avr->ioend && same < 64; at--) {
        same = avr->data[at] == PAINT ? same + 1 : 0;
        if (same == 0)
            lowest = at;
    }
    load->stack = avr->ramend + 1 - lowest;
}
