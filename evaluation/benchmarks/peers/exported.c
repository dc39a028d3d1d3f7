/* SPDX-License-Identifier: Apache-2.0 */
/* A recording by an exported model: by its C functions, and by an FMU's functions as a simulator in C calls them. */
#include "aeropend_model.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

void by_c(long n, const double *duty, Outputs *out)
{
    aeropend model;
    aeropend_begin(&model, 0.0);
    for (long k = 0; k < n; k++) {
        out[k] = aeropend_read(&model, duty[k]);
        aeropend_advance(&model, duty[k], 0.0);
    }
}

typedef int Set(void *, const uint32_t *, size_t, const double *, size_t);
typedef int Get(void *, const uint32_t *, size_t, double *, size_t);
typedef int Step(void *, double, double, bool, bool *, bool *, bool *, double *);

void by_fmu(long n, const double *duty, double *out, void *instance, Set *set, Get *get, Step *step, uint32_t first)
{
    enum { OUTPUTS = sizeof(Outputs) / sizeof(double) };
    uint32_t duty_reference = 1, references[OUTPUTS];
    for (uint32_t k = 0; k < OUTPUTS; k++)
        references[k] = first + k;
    for (long k = 0; k < n; k++) {
        bool event, stop, early;
        double reached;
        set(instance, &duty_reference, 1, &duty[k], 1);
        get(instance, references, OUTPUTS, out + k * OUTPUTS, OUTPUTS);
        step(instance, (double)k * AEROPEND_PERIOD, AEROPEND_PERIOD, true, &event, &stop, &early, &reached);
    }
}
