/* SPDX-License-Identifier: Apache-2.0 */
/* The functions of FMI 3.0 for co-simulation (https://fmi-standard.org/docs/3.0.2) around a model of aeropend.
 * Types are written as the standard defines them (fmi3PlatformTypes.h), so that no header of it is needed. */
#include "aeropend_model.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { OK, WARNING, DISCARD, ERROR, FATAL };
enum { TIME, DUTY, NOISE, THETA_START, FIRST_OUTPUT = AEROPEND_FIRST_OUTPUT, OUTPUTS = sizeof(Outputs) / sizeof(double) };
/* Value references; the outputs have theirs in the order of Outputs (fmu.py). */

#define ROUNDING 1e-6 /* share of a period by which a time may miss a sample: a choice, far above rounding */

typedef void (*Log)(void *environment, int status, const char *category, const char *message);

typedef struct {
    aeropend model;
    double start, time, duty, noise, theta_start;
    int64_t samples;
    Outputs shown;
    void *environment;
    Log log;
} Instance;

static int fail(const Instance *i, const char *message)
{
    if (i->log)
        i->log(i->environment, ERROR, "logStatusError", message);
    return ERROR;
}

static void begin_again(Instance *i)
{
    aeropend_begin(&i->model, i->theta_start);
    i->samples = 0;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT int fmi3SetDebugLogging(void *instance, bool on, size_t count, const char *const categories[])
{
    (void)instance, (void)on, (void)count, (void)categories;
    return OK;
}

EXPORT void *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging, bool events, bool early,
    const uint32_t intermediate[], size_t count, void *environment, Log log, void (*update)(void))
{
    Instance *i;
    (void)name, (void)resources, (void)visible, (void)events, (void)early, (void)intermediate, (void)count, (void)update;
    if (strcmp(token, AEROPEND_TOKEN) != 0) {
        if (log)
            log(environment, ERROR, "logStatusError", "the instantiation token is that of another FMU");
        return NULL;
    }
    i = calloc(1, sizeof *i);
    if (i) {
        i->environment = environment;
        i->log = logging ? log : NULL;
        begin_again(i);
    }
    return i;
}

EXPORT void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *resources, bool visible,
                                          bool logging, void *environment, Log log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)log;
    return NULL;
}

EXPORT void *fmi3InstantiateScheduledExecution(
    const char *name, const char *token, const char *resources, bool visible, bool logging, void *environment, Log log,
    void (*clock)(void), void (*lock)(void), void (*unlock)(void))
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)log;
    (void)clock, (void)lock, (void)unlock;
    return NULL;
}

EXPORT void fmi3FreeInstance(void *instance) { free(instance); }

EXPORT int fmi3EnterInitializationMode(void *instance, bool tolerance_defined, double tolerance, double start,
                                       bool stop_defined, double stop)
{
    Instance *i = instance;
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop;
    i->start = i->time = start;
    begin_again(i);
    return OK;
}

EXPORT int fmi3ExitInitializationMode(void *instance)
{
    begin_again(instance);
    return OK;
}

EXPORT int fmi3EnterEventMode(void *instance) { return fail(instance, "this FMU has no events"); }
EXPORT int fmi3EnterStepMode(void *instance) { return (void)instance, OK; }
EXPORT int fmi3EnterConfigurationMode(void *instance) { return (void)instance, OK; }
EXPORT int fmi3ExitConfigurationMode(void *instance) { return (void)instance, OK; }
EXPORT int fmi3Terminate(void *instance) { return (void)instance, OK; }
EXPORT int fmi3EvaluateDiscreteStates(void *instance) { return (void)instance, OK; }

EXPORT int fmi3Reset(void *instance)
{
    Instance *i = instance;
    i->start = i->time = i->duty = i->noise = i->theta_start = 0.0;
    begin_again(i);
    return OK;
}

EXPORT int fmi3UpdateDiscreteStates(void *instance, bool *again, bool *stop, bool *nominals, bool *values, bool *next,
                                    double *at)
{
    (void)instance, (void)at;
    *again = *stop = *nominals = *values = *next = false;
    return OK;
}

EXPORT int fmi3DoStep(void *instance, double now, double size, bool no_return, bool *event, bool *stop, bool *early,
                      double *reached)
{
    Instance *i = instance;
    double due;
    (void)no_return;
    *event = *stop = *early = false;
    *reached = now;
    if (!(size >= 0.0) || !isfinite(now + size))
        return fail(i, "the length of a communication step is not a time");
    if (!isfinite(i->duty) || !isfinite(i->noise))
        return fail(i, "duty or noise is not a number");
    due = floor((now + size - i->start) / AEROPEND_PERIOD + ROUNDING);
    for (; (double)i->samples < due; i->samples++)
        aeropend_advance(&i->model, i->duty, i->noise);
    *reached = i->time = now + size;
    return OK;
}

EXPORT int fmi3GetFloat64(void *instance, const uint32_t which[], size_t count, double values[], size_t room)
{
    Instance *i = instance;
    size_t k;
    (void)room;
    i->shown = aeropend_read(&i->model, i->duty);
    for (k = 0; k < count; k++) {
        if (which[k] == TIME)
            values[k] = i->time;
        else if (which[k] == DUTY)
            values[k] = i->duty;
        else if (which[k] == NOISE)
            values[k] = i->noise;
        else if (which[k] == THETA_START)
            values[k] = i->theta_start;
        else if (which[k] >= FIRST_OUTPUT && which[k] < FIRST_OUTPUT + OUTPUTS)
            values[k] = ((const double *)&i->shown)[which[k] - FIRST_OUTPUT];
        else
            return fail(i, "there is no variable with this value reference");
    }
    return OK;
}

EXPORT int fmi3SetFloat64(void *instance, const uint32_t which[], size_t count, const double values[], size_t room)
{
    Instance *i = instance;
    size_t k;
    (void)room;
    for (k = 0; k < count; k++) {
        if (which[k] == DUTY)
            i->duty = values[k];
        else if (which[k] == NOISE)
            i->noise = values[k];
        else if (which[k] == THETA_START)
            i->theta_start = values[k];
        else
            return fail(i, "no variable that can be set has this value reference");
    }
    return OK;
}

/* There are no variables of other types. */
#define NO_VARIABLES(name, type) \
    EXPORT int fmi3Get##name(void *i, const uint32_t which[], size_t count, type values[], size_t room) \
    { return (void)which, (void)values, (void)room, count ? fail(i, "no variable has this type") : OK; } \
    EXPORT int fmi3Set##name(void *i, const uint32_t which[], size_t count, const type values[], size_t room) \
    { return (void)which, (void)values, (void)room, count ? fail(i, "no variable has this type") : OK; }
typedef const char *String;
NO_VARIABLES(Float32, float)
NO_VARIABLES(Int8, int8_t)
NO_VARIABLES(UInt8, uint8_t)
NO_VARIABLES(Int16, int16_t)
NO_VARIABLES(UInt16, uint16_t)
NO_VARIABLES(Int32, int32_t)
NO_VARIABLES(UInt32, uint32_t)
NO_VARIABLES(Int64, int64_t)
NO_VARIABLES(UInt64, uint64_t)
NO_VARIABLES(Boolean, bool)
NO_VARIABLES(String, String)

/* What the model description says that this FMU does not offer. */
#define NOT_OFFERED(name, ...) \
    EXPORT int fmi3##name(void *i, __VA_ARGS__) { return fail(i, "fmi3" #name " is not offered by this FMU"); }
NOT_OFFERED(GetBinary, const uint32_t *a, size_t b, size_t *c, const uint8_t **d, size_t e)
NOT_OFFERED(SetBinary, const uint32_t *a, size_t b, const size_t *c, const uint8_t *const *d, size_t e)
NOT_OFFERED(GetClock, const uint32_t *a, size_t b, bool *c)
NOT_OFFERED(SetClock, const uint32_t *a, size_t b, const bool *c)
NOT_OFFERED(GetNumberOfVariableDependencies, uint32_t a, size_t *b)
NOT_OFFERED(GetVariableDependencies, uint32_t a, size_t *b, uint32_t *c, size_t *d, int *e, size_t f)
NOT_OFFERED(GetDirectionalDerivative, const uint32_t *a, size_t b, const uint32_t *c, size_t d, const double *e, size_t f,
            double *g, size_t h)
NOT_OFFERED(GetAdjointDerivative, const uint32_t *a, size_t b, const uint32_t *c, size_t d, const double *e, size_t f,
            double *g, size_t h)
NOT_OFFERED(GetOutputDerivatives, const uint32_t *a, size_t b, const int32_t *c, double *d, size_t e)
NOT_OFFERED(GetIntervalDecimal, const uint32_t *a, size_t b, double *c, int *d)
NOT_OFFERED(GetIntervalFraction, const uint32_t *a, size_t b, uint64_t *c, uint64_t *d, int *e)
NOT_OFFERED(GetShiftDecimal, const uint32_t *a, size_t b, double *c)
NOT_OFFERED(GetShiftFraction, const uint32_t *a, size_t b, uint64_t *c, uint64_t *d)
NOT_OFFERED(SetIntervalDecimal, const uint32_t *a, size_t b, const double *c)
NOT_OFFERED(SetIntervalFraction, const uint32_t *a, size_t b, const uint64_t *c, const uint64_t *d)
NOT_OFFERED(SetShiftDecimal, const uint32_t *a, size_t b, const double *c)
NOT_OFFERED(SetShiftFraction, const uint32_t *a, size_t b, const uint64_t *c, const uint64_t *d)
NOT_OFFERED(ActivateModelPartition, uint32_t a, double b)
NOT_OFFERED(CompletedIntegratorStep, bool a, bool *b, bool *c)
NOT_OFFERED(SetTime, double a)
NOT_OFFERED(SetContinuousStates, const double *a, size_t b)
NOT_OFFERED(GetContinuousStates, double *a, size_t b)
NOT_OFFERED(GetContinuousStateDerivatives, double *a, size_t b)
NOT_OFFERED(GetNominalsOfContinuousStates, double *a, size_t b)
NOT_OFFERED(GetEventIndicators, double *a, size_t b)
NOT_OFFERED(GetNumberOfEventIndicators, size_t *a)
NOT_OFFERED(GetNumberOfContinuousStates, size_t *a)
EXPORT int fmi3EnterContinuousTimeMode(void *i) { return fail(i, "this FMU is for co-simulation"); }

/* A kept state is a copy of the instance. */
EXPORT int fmi3GetFMUState(void *instance, void **kept)
{
    if (!*kept)
        *kept = malloc(sizeof(Instance));
    if (!*kept)
        return fail(instance, "out of memory");
    memcpy(*kept, instance, sizeof(Instance));
    return OK;
}

EXPORT int fmi3SetFMUState(void *instance, void *kept)
{
    Instance *i = instance;
    void *environment = i->environment;
    Log log = i->log;
    memcpy(i, kept, sizeof *i);
    i->environment = environment;
    i->log = log;
    return OK;
}

EXPORT int fmi3FreeFMUState(void *instance, void **kept)
{
    (void)instance;
    free(*kept);
    *kept = NULL;
    return OK;
}

EXPORT int fmi3SerializedFMUStateSize(void *instance, void *kept, size_t *size)
{
    (void)instance, (void)kept;
    *size = sizeof(Instance);
    return OK;
}

EXPORT int fmi3SerializeFMUState(void *instance, void *kept, uint8_t bytes[], size_t size)
{
    if (size < sizeof(Instance))
        return fail(instance, "too little room for a state");
    memcpy(bytes, kept, sizeof(Instance));
    return OK;
}

EXPORT int fmi3DeserializeFMUState(void *instance, const uint8_t bytes[], size_t size, void **kept)
{
    if (size != sizeof(Instance))
        return fail(instance, "these bytes are no state of this FMU");
    if (!*kept)
        *kept = malloc(sizeof(Instance));
    if (!*kept)
        return fail(instance, "out of memory");
    memcpy(*kept, bytes, sizeof(Instance));
    return OK;
}
