// SPDX-License-Identifier: Apache-2.0
// The board of the aeropendulum: an ATmega2560 at 16 MHz.
//
// Timer1 generates the PWM, phase-correct, so that its overflow is in the middle of the pulse. Each sample starts there.
// The interrupt of the ADC starts the next conversion. The last one wakes the main loop, which computes the speed, runs
// the controller, sends the frame and resets the watchdog. So the board runs only while samples are taken and sent.
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <math.h>
#include <string.h>
#include <util/atomic.h>
#include <util/parity.h>

#include "pid.h"
#include "pins.h"
#include "protocol.h"
#include "speed.h"

#define TOP 255
#define PERIOD_TICKS (2UL * TOP * 64 / 8) // of Timer4 in one period of the PWM
#define PERIOD_S (2.0f * TOP * 64 / F_CPU)

// Periods without a command after which the duty is 0. The register is cleared 96 to 98 ms after the last command, and
// the pin follows in at most 1 ms.
#define COMMAND_TIMEOUT 48

#define RAD_PER_COUNT ((float)(2.0 * M_PI / 1024.0))

// Cause of the last reset, read before all else: after a watchdog reset the watchdog is still on, with its shortest time.
static uint8_t reset_cause __attribute__((section(".noinit")));

void save_reset_cause(void) __attribute__((naked, used, section(".init3")));
void save_reset_cause(void) {
    reset_cause = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

// --- time ----------------------------------------------------------------------------------------------------------

static volatile uint16_t overflows; // of Timer4: the high half of the board's time

ISR(TIMER4_OVF_vect) {
    overflows++;
}

// The board's time of a count of Timer4, with interrupts off. A pending overflow was before the count if the count is
// small; then this interrupt was served first.
static inline uint32_t board_time(uint16_t count) {
    uint16_t high = overflows;
    if ((TIFR4 & _BV(TOV4)) && count < 0x8000)
        high++;
    return (uint32_t)high << 16 | count;
}

// --- pulses --------------------------------------------------------------------------------------------------------

#define PULSES 8
static volatile uint32_t pulses[PULSES];
static volatile uint8_t pulses_in, pulses_out;
static volatile uint16_t events; // flags of the next sample

ISR(TIMER4_CAPT_vect) {
    uint32_t time = board_time(ICR4);
    uint8_t next = (pulses_in + 1) % PULSES;
    if (next == pulses_out) {
        events |= FLAG_PULSE_REJECTED;
        return;
    }
    pulses[pulses_in] = time;
    pulses_in = next;
}

// --- the sample ----------------------------------------------------------------------------------------------------

static struct sample {
    uint32_t time;
    uint16_t current, angle; // by SSI: all 16 bits of the encoder
    int16_t voltage;
    uint8_t sequence, duty, scheme;
} sample;
static volatile bool sample_ready;
static volatile uint8_t scheme;

static uint8_t duty_register; // last value of OCR1A
static uint8_t duty_acting;   // duty until the next TOP, if the register was changed since the last one
static bool duty_changed;
static volatile uint8_t command_age = COMMAND_TIMEOUT; // periods

// Sets the output compare register, with interrupts off. The timer takes the value at TOP; OCF1B shows whether TOP was
// since the last sample. Just before TOP this function waits, 8 us at most, because the two could otherwise disagree.
static void set_duty(uint8_t duty) {
    while (TCNT1 >= TOP - 1 && !(TIFR1 & _BV(OCF1B)))
        ;
    if ((TIFR1 & _BV(OCF1B)) && !duty_changed) {
        duty_acting = duty_register;
        duty_changed = true;
    }
    OCR1A = duty_register = duty;
}

// Reads the AS5040: 10 bits of position and 6 of status. At least 0.5 us between edges of the clock.
static inline uint16_t ssi_read(void) {
    uint16_t word = 0;
    PORTA &= ~_BV(SSI_SELECT);
    __builtin_avr_delay_cycles(8);
    for (uint8_t bit = 0; bit < 16; bit++) {
        PORTA &= ~_BV(SSI_CLOCK);
        word <<= 1;
        __builtin_avr_delay_cycles(5);
        PORTA |= _BV(SSI_CLOCK);
        __builtin_avr_delay_cycles(6); // the bit is valid 0.375 us after the edge
        if (PINA & _BV(SSI_DATA))
            word |= 1;
    }
    PORTA |= _BV(SSI_SELECT);
    return word;
}

static uint8_t ssi_flags(uint16_t word) {
    uint8_t flags = FLAG_SSI;
    if (parity_even_bit(word >> 8 ^ (uint8_t)word))
        flags |= FLAG_SSI_PARITY;
    if ((word & 0x38) != 0x20) // OCF 1, COF 0, LIN 0
        flags |= FLAG_SSI_STATUS;
    return flags;
}

static enum { CURRENT, ANGLE, SETTLE_FIRST, SETTLE_SECOND, VOLTAGE } conversion;

// Prescaler 128: 125 kHz, 104 us a conversion.
#define ADC_START (_BV(ADEN) | _BV(ADSC) | _BV(ADIE) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0))

ISR(TIMER1_OVF_vect) {
    ADCSRA = ADC_START; // the current first: it is present only while the pulse is high
    conversion = CURRENT;
    // both timers have one prescaler, so the distance of samples is exactly this
    uint32_t now = board_time(TCNT4);
    do {
        sample.time += PERIOD_TICKS;
        sample.sequence++;
    } while ((int32_t)(now - sample.time) >= (int32_t)PERIOD_TICKS);
    sample.duty = duty_changed ? duty_acting : duty_register;
    duty_changed = false;
    TIFR1 = _BV(OCF1B);
    if (command_age < COMMAND_TIMEOUT && ++command_age == COMMAND_TIMEOUT)
        set_duty(0);
    sample.scheme = scheme;
    if (scheme == SCHEME_SSI) {
        sei(); // the receiver cannot wait so long, but the clock of the encoder can
        sample.angle = ssi_read();
    }
}

ISR(ADC_vect) {
    switch (conversion) {
    case CURRENT:
        sample.current = ADC;
        if (sample.scheme == SCHEME_PWM) {
            ADMUX = ADC_ANGLE;
            conversion = ANGLE;
        } else {
            ADMUX = ADC_VOLTAGE;
            conversion = SETTLE_FIRST;
        }
        break;
    case ANGLE:
        sample.angle = ADC;
        ADMUX = ADC_VOLTAGE;
        conversion = SETTLE_FIRST;
        break;
    case SETTLE_FIRST: // the differential stage needs 125 us: earlier conversions are discarded
        conversion = SETTLE_SECOND;
        break;
    case SETTLE_SECOND:
        conversion = VOLTAGE;
        break;
    case VOLTAGE:
        sample.voltage = (int16_t)(ADC << 6) >> 6; // two's complement of 10 bits
        ADMUX = ADC_CURRENT;
        sample_ready = true;
        return;
    }
    ADCSRA = ADC_START;
}

// --- the line ------------------------------------------------------------------------------------------------------

#define RECEIVED 128
static volatile uint8_t received[RECEIVED];
static volatile uint8_t received_in;
static uint8_t received_out;

ISR(USART0_RX_vect) {
    if (UCSR0A & (_BV(DOR0) | _BV(FE0)))
        events |= FLAG_RECEIVE_ERROR;
    uint8_t byte = UDR0;
    uint8_t next = (received_in + 1) % RECEIVED;
    if (next == received_out) {
        events |= FLAG_RECEIVE_ERROR;
        return;
    }
    received[received_in] = byte;
    received_in = next;
}

#define TO_SEND 256
static volatile uint8_t to_send[TO_SEND];
static volatile uint8_t to_send_out;
static uint8_t to_send_in;

ISR(USART0_UDRE_vect) {
    uint8_t at = to_send_out;
    UDR0 = to_send[at++];
    to_send_out = at;
    if (at == to_send_in)
        UCSR0B &= ~_BV(UDRIE0);
}

// Sends all bytes, or none if there is no room. The host sees the gap in the sequence.
static void send_bytes(const uint8_t *bytes, uint8_t length) {
    uint8_t used = to_send_in - to_send_out;
    if (length >= TO_SEND - used)
        return;
    uint8_t at = to_send_in;
    while (length--)
        to_send[at++] = *bytes++;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        to_send_in = at;
        UCSR0B |= _BV(UDRIE0);
    }
}

static void send(const uint8_t *payload, uint8_t length) {
    uint8_t frame[FRAME_MAX];
    send_bytes(frame, frame_encode(payload, length, frame));
}

// --- commands ------------------------------------------------------------------------------------------------------

static bool enabled;
static uint8_t mode;
static struct pid pid = {.gains = {.high = 1.0f}};
static uint8_t calibration[CALIBRATION_SIZE];
static uint8_t EEMEM stored_calibration[CALIBRATION_SIZE];
static uint8_t calibration_left; // bytes to be written

static void send_hello(void) {
    uint8_t payload[11 + CALIBRATION_SIZE] = {HELLO,          PROTOCOL_VERSION, FIRMWARE_MAJOR, FIRMWARE_MINOR,
                                              FIRMWARE_PATCH, reset_cause,      scheme};
    const uint32_t build = BUILD_ID;
    memcpy(payload + 7, calibration, CALIBRATION_SIZE);
    memcpy(payload + 7 + CALIBRATION_SIZE, &build, 4);
    send(payload, sizeof payload);
}

static void send_ack(uint8_t type, uint8_t status) {
    const uint8_t payload[] = {ACK, type, status};
    send(payload, sizeof payload);
}

static void command_duty(uint8_t duty) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        set_duty(duty);
        command_age = 0;
    }
}

// Duty 0 until the next command.
static void rest(void) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        set_duty(0);
        command_age = COMMAND_TIMEOUT;
    }
    pid_reset(&pid);
}

static uint8_t on_duty(const uint8_t *payload) {
    uint16_t duty;
    memcpy(&duty, payload + 2, 2);
    if (enabled && mode == MODE_DIRECT)
        // rounds duty * TOP / 65535 without a division, which the compiler would move to a place with interrupts off
        command_duty((uint8_t)(((uint32_t)duty * TOP + 32895) >> 16));
    return OK;
}

static uint8_t on_enable(const uint8_t *payload) {
    if (payload[1] > 1)
        return BAD_VALUE;
    if (!payload[1] || !enabled)
        rest();
    enabled = payload[1];
    return OK;
}

static uint8_t on_scheme(const uint8_t *payload) {
    if (payload[1] > SCHEME_SSI)
        return BAD_VALUE;
    scheme = payload[1];
    return OK;
}

static uint8_t on_gains(const uint8_t *payload) {
    struct gains gains;
    memcpy(&gains, payload + 1, sizeof gains);
    if (!gains_valid(&gains))
        return BAD_VALUE;
    pid.gains = gains;
    return OK;
}

static uint8_t on_reference(const uint8_t *payload) {
    float reference;
    memcpy(&reference, payload + 1, sizeof reference);
    if (!isfinite(reference))
        return BAD_VALUE;
    if (!enabled)
        return DISABLED;
    pid.reference = reference;
    if (mode == MODE_PID)
        command_age = 0;
    return OK;
}

static uint8_t on_mode(const uint8_t *payload) {
    if (payload[1] > MODE_PID)
        return BAD_VALUE;
    if (payload[1] != mode)
        rest();
    mode = payload[1];
    return OK;
}

static void on_calibration(const uint8_t *payload) { // acknowledged after it is written
    memcpy(calibration, payload + 1, CALIBRATION_SIZE);
    calibration_left = CALIBRATION_SIZE;
}

static void on_message(const uint8_t *payload, uint8_t length) {
    static const struct {
        uint8_t type, length;
        uint8_t (*take)(const uint8_t *);
    } commands[] = {
        {DUTY, 4, on_duty},       {ENABLE, 2, on_enable},           {SCHEME, 2, on_scheme},
        {PID_GAINS, 25, on_gains}, {PID_REFERENCE, 5, on_reference}, {MODE, 2, on_mode},
    };
    const uint8_t type = payload[0];
    if (type == HELLO_REQUEST && length == 1) {
        send_hello();
        return;
    }
    if (type == WRITE_CALIBRATION && length == 1 + CALIBRATION_SIZE) {
        on_calibration(payload);
        return;
    }
    for (uint8_t i = 0; i < sizeof commands / sizeof *commands; i++) {
        if (commands[i].type == type) {
            uint8_t status = commands[i].length == length ? commands[i].take(payload) : BAD_VALUE;
            if (type != DUTY)
                send_ack(type, status);
            return;
        }
    }
    send_ack(type, type == HELLO_REQUEST || type == WRITE_CALIBRATION ? BAD_VALUE : UNKNOWN_TYPE);
}

static void receive(void) {
    static struct decoder decoder;
    while (received_out != received_in) {
        uint8_t byte = received[received_out];
        received_out = (received_out + 1) % RECEIVED;
        uint8_t length = frame_decode(&decoder, byte);
        if (length)
            on_message(decoder.bytes, length);
        if (decoder.bad) {
            decoder.bad = false;
            ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
                events |= FLAG_RECEIVE_ERROR;
            }
        }
    }
}

// --- the main loop -------------------------------------------------------------------------------------------------

static struct speed speed;

static uint16_t take_pulses(uint32_t now) {
    uint16_t flags = 0;
    while (pulses_out != pulses_in) {
        enum pulse pulse = speed_pulse(&speed, pulses[pulses_out]);
        pulses_out = (pulses_out + 1) % PULSES;
        if (pulse == PULSE_PERIOD)
            flags |= FLAG_NEW_PERIOD;
        else if (pulse == PULSE_REJECTED)
            flags |= FLAG_PULSE_REJECTED;
    }
    speed_age(&speed, now);
    return flags;
}

static void finish_sample(void) {
    struct sample s;
    uint16_t flags;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        s = sample;
        flags = events;
        events = 0;
        sample_ready = false;
    }
    flags |= take_pulses(s.time);
    if (s.scheme == SCHEME_SSI) {
        flags |= ssi_flags(s.angle);
        s.angle >>= 6;
    }
    if (enabled) {
        flags |= FLAG_ENABLED;
        if (command_age >= COMMAND_TIMEOUT)
            flags |= FLAG_COMMAND_TIMEOUT;
    }
    if (mode == MODE_PID) {
        flags |= FLAG_PID;
        // an invalid reading of the encoder holds the duty
        if (enabled && !(flags & (FLAG_SSI_PARITY | FLAG_SSI_STATUS))) {
            uint8_t duty = pid_step(&pid, RAD_PER_COUNT * s.angle, PERIOD_S) * TOP + 0.5f;
            ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
                if (command_age < COMMAND_TIMEOUT)
                    set_duty(duty);
            }
            if (flags & FLAG_COMMAND_TIMEOUT)
                pid_reset(&pid);
        }
    }
    if (reset_cause & _BV(WDRF))
        flags |= FLAG_WATCHDOG_RESET;
    if (reset_cause & _BV(BORF))
        flags |= FLAG_BROWN_OUT;

    uint8_t payload[19] = {SAMPLE, s.sequence};
    memcpy(payload + 2, &s.time, 4);
    payload[6] = s.duty;
    memcpy(payload + 7, &s.current, 2);
    memcpy(payload + 9, &s.angle, 2);
    memcpy(payload + 11, &s.voltage, 2);
    memcpy(payload + 13, &speed.period, 4);
    memcpy(payload + 17, &flags, 2);
    send(payload, sizeof payload);
}

static void write_calibration(void) {
    if (!calibration_left || !eeprom_is_ready())
        return;
    uint8_t at = CALIBRATION_SIZE - calibration_left;
    eeprom_update_byte(&stored_calibration[at], calibration[at]);
    if (--calibration_left == 0)
        send_ack(WRITE_CALIBRATION, OK);
}

static void start(void) {
    DDRB |= _BV(PWM_PIN) | _BV(DIRECTION_PIN);
    PORTB |= _BV(DIRECTION_PIN);
    DDRH |= _BV(BRAKE_PIN);
    PORTA |= _BV(SSI_SELECT) | _BV(SSI_CLOCK);
    DDRA |= _BV(SSI_SELECT) | _BV(SSI_CLOCK);

    UBRR0 = F_CPU / 8 / BAUD - 1;
    UCSR0A = _BV(U2X0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);

    ADMUX = ADC_CURRENT;
    ADCSRA = ADC_START & ~(_BV(ADSC) | _BV(ADIE));
    DIDR0 = 0x0F; // A0..A3 are analogue only

    GTCCR = _BV(TSM) | _BV(PSRSYNC); // holds the prescaler, so that both timers start together
    OCR1A = 0;
    OCR1B = TOP;
    TCNT1 = TCNT4 = 0;
    TCCR1A = _BV(COM1A1) | _BV(WGM10); // phase-correct, 8 bit, high while it counts below OCR1A
    TCCR1B = _BV(CS11) | _BV(CS10);    // 16 MHz / 64 / 510 = 490.2 Hz
    TCCR4A = 0;
    TCCR4B = _BV(ICNC4) | _BV(ICES4) | _BV(CS41); // captures rising edges, 0.5 us
    TIFR1 = TIFR4 = 0xFF;
    TIMSK1 = _BV(TOIE1);
    TIMSK4 = _BV(ICIE4) | _BV(TOIE4);
    GTCCR = 0;
}

int main(void) {
    eeprom_read_block(calibration, stored_calibration, CALIBRATION_SIZE);
    start();
    wdt_enable(WDTO_60MS);
    set_sleep_mode(SLEEP_MODE_IDLE);
    sei();
    send_bytes((const uint8_t[]){0}, 1); // ends a frame that a reset interrupted
    send_hello();
    for (;;) {
        cli();
        if (!sample_ready && received_out == received_in) {
            sleep_enable();
            sei(); // takes effect after the next instruction, so that no interrupt is missed
            sleep_cpu();
            sleep_disable();
        }
        sei();
        receive();
        if (sample_ready) {
            finish_sample();
            wdt_reset();
        }
        write_calibration();
    }
}
