// SPDX-License-Identifier: Apache-2.0
// The pins; README.md, "Wiring", has the same as a table.
#ifndef PINS_H
#define PINS_H

#include <avr/io.h>

// Arduino motor shield R3, channel A, its PWM input fed from D11
#define PWM_PIN PB5       // D11, OC1A
#define DIRECTION_PIN PB6 // D12: high is forwards
#define BRAKE_PIN PH6     // D9: low lets it turn

// AS5040 by SSI, on port A
#define SSI_SELECT PA0 // D22, CSn
#define SSI_CLOCK PA1  // D23, CLK
#define SSI_DATA PA2   // D24, DO

// the IR sensor is on ICP4: PL0, D49

// analogue inputs, all against the internal 2.56 V
#define ADC_REFERENCE (_BV(REFS1) | _BV(REFS0))
#define ADC_CURRENT (ADC_REFERENCE | 0)    // A0, SNS0
#define ADC_ANGLE (ADC_REFERENCE | 2)      // A2, the AS5040's PWM output, filtered
#define ADC_VOLTAGE (ADC_REFERENCE | 0x13) // A3 - A1, gain 1

#endif
