/* The functions of FMI 3.0 for co-simulation, over bench.h (FMI Specification 3.0, 2022). */
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "bench.h"
#include "scene.h"

#define EXPORT __attribute__((visibility("default")))

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } status_t;
typedef uint32_t reference_t;
typedef void (*log_t)(void *environment, status_t status, const char *category, const char *text);
typedef enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED } mode_t3;

typedef struct {
  void *environment;
  log_t log;
  bool may_return_early;
  mode_t3 mode;
  cs_bench *bench;
} instance_t;

/* Value references: 0 is the time, then parameters, inputs, outputs. */
enum { TIME = 0, FIRST_PARAMETER = 1 };
#define FIRST_INPUT (FIRST_PARAMETER + CS_PARAMETER_COUNT)
#define FIRST_OUTPUT (FIRST_INPUT + CS_INPUT_COUNT)
#define END_OF_REFERENCES (FIRST_OUTPUT + CS_OUTPUT_COUNT)

static status_t report(instance_t *instance, status_t status, const char *format, ...) {
  char text[400];
  va_list values;
  va_start(values, format);
  vsnprintf(text, sizeof text, format, values);
  va_end(values);
  if (instance->log) instance->log(instance->environment, status, "logStatusError", text);
  return status;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT status_t fmi3SetDebugLogging(void *instance, bool on, size_t n, const char *const *categories) {
  (void)instance, (void)on, (void)n, (void)categories;
  return OK; /* errors are always reported, nothing else is */
}

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                         bool visible, bool logging, bool event_mode,
                                         bool may_return_early, const reference_t *intermediate,
                                         size_t n_intermediate, void *environment, log_t log,
                                         void *intermediate_update) {
  instance_t refused = {environment, log, false, INSTANTIATED, NULL}, *instance;
  void *memory;
  (void)name, (void)resources, (void)visible, (void)logging, (void)intermediate;
  (void)n_intermediate, (void)intermediate_update;
  if (!token || strcmp(token, CS_TOKEN)) {
    report(&refused, ERROR, "instantiationToken: must be that of modelDescription.xml, " CS_TOKEN);
    return NULL;
  }
  if (event_mode) {
    report(&refused, ERROR, "eventModeUsed = true: must be false, this unit has no event mode");
    return NULL;
  }
  instance = malloc(sizeof *instance);
  memory = malloc(cs_size());
  refused.bench = instance && memory ? cs_begin(memory) : NULL;
  if (!refused.bench) {
    report(&refused, ERROR, instance && memory
           ? "this processor lacks instructions that the unit was compiled for; "
             "export it with --portable"
           : "out of memory");
    free(instance);
    free(memory);
    return NULL;
  }
  *instance = refused;
  instance->may_return_early = may_return_early;
  return instance;
}

EXPORT void fmi3FreeInstance(instance_t *instance) {
  if (!instance) return;
  free(instance->bench);
  free(instance);
}

EXPORT status_t fmi3EnterInitializationMode(instance_t *instance, bool has_tolerance,
                                            double tolerance, double start, bool has_stop,
                                            double stop) {
  (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
  if (start != 0.0)
    return report(instance, ERROR, "startTime = %.9g s: must be 0, the release", start);
  instance->mode = INITIALIZING;
  return OK;
}

static status_t outcome(instance_t *instance, cs_result result) {
  if (result == CS_FAILED || result == CS_REJECTED)
    return report(instance, ERROR, "%s", cs_message(instance->bench));
  return OK;
}

EXPORT status_t fmi3ExitInitializationMode(instance_t *instance) {
  instance->mode = STEPPING;
  return outcome(instance, cs_advance(instance->bench, 0.0, false));
}

EXPORT status_t fmi3Terminate(instance_t *instance) {
  instance->mode = TERMINATED;
  return OK;
}

EXPORT status_t fmi3Reset(instance_t *instance) {
  cs_begin(instance->bench);
  instance->mode = INSTANTIATED;
  return OK;
}

EXPORT status_t fmi3DoStep(instance_t *instance, double t, double step, bool is_final,
                           bool *needs_events, bool *terminate, bool *is_early, double *last) {
  double present = cs_time(instance->bench);
  cs_result result;
  (void)is_final;
  *needs_events = *terminate = *is_early = false;
  *last = present;
  if (instance->mode != STEPPING)
    return report(instance, ERROR, "fmi3DoStep: must follow fmi3ExitInitializationMode");
  if (!(step > 0.0))
    return report(instance, ERROR, "communicationStepSize = %.9g s: must be > 0", step);
  /* communication points are sums of steps: those of the master differ by round-off */
  if (!(t - present < 1e-9 && present - t < 1e-9))
    return report(instance, ERROR, "currentCommunicationPoint = %.9g s: must be %.9g", t, present);
  result = cs_advance(instance->bench, t + step, instance->may_return_early);
  *last = cs_time(instance->bench);
  *is_early = result == CS_EVENT;
  *terminate = result == CS_ENDED;
  return outcome(instance, result);
}

/* Values */

static const cs_variable *variable(reference_t reference) {
  if (reference >= FIRST_PARAMETER && reference < FIRST_INPUT)
    return cs_parameter(reference - FIRST_PARAMETER);
  if (reference >= FIRST_INPUT && reference < FIRST_OUTPUT) return cs_input(reference - FIRST_INPUT);
  if (reference >= FIRST_OUTPUT && reference < END_OF_REFERENCES)
    return cs_output(reference - FIRST_OUTPUT);
  return NULL;
}

static status_t check_type(instance_t *instance, reference_t reference, cs_type type) {
  static const char *const names[] = {"Float64", "Int64", "Boolean"};
  const cs_variable *v = variable(reference);
  if (v ? v->type == type : reference == TIME && type == CS_REAL) return OK;
  return report(instance, ERROR, "value reference %u: no %s of this unit", (unsigned)reference,
                names[type]);
}

static status_t get(instance_t *instance, reference_t reference, cs_type type, double *value) {
  status_t status = check_type(instance, reference, type);
  if (status != OK) return status;
  if (reference == TIME)
    *value = cs_time(instance->bench);
  else if (reference < FIRST_INPUT)
    *value = cs_get(instance->bench, reference - FIRST_PARAMETER);
  else if (reference < FIRST_OUTPUT)
    *value = cs_given(instance->bench, reference - FIRST_INPUT);
  else
    *value = cs_read(instance->bench, reference - FIRST_OUTPUT);
  return OK;
}

static status_t set(instance_t *instance, reference_t reference, cs_type type, double value) {
  status_t status = check_type(instance, reference, type);
  if (status != OK) return status;
  if (reference == TIME || reference >= FIRST_OUTPUT)
    return report(instance, ERROR, "value reference %u: not a parameter or input",
                  (unsigned)reference);
  return outcome(instance, reference < FIRST_INPUT
                               ? cs_set(instance->bench, reference - FIRST_PARAMETER, value)
                               : cs_put(instance->bench, reference - FIRST_INPUT, value));
}

static status_t check_sizes(instance_t *instance, size_t references, size_t values) {
  if (references == values) return OK;
  return report(instance, ERROR, "nValues = %zu: must be %zu, every variable is a scalar", values,
                references);
}

EXPORT status_t fmi3GetFloat64(instance_t *instance, const reference_t *references, size_t n,
                               double *values, size_t n_values) {
  status_t status = check_sizes(instance, n, n_values);
  for (size_t k = 0; k < n && status == OK; k++)
    status = get(instance, references[k], CS_REAL, &values[k]);
  return status;
}

EXPORT status_t fmi3GetInt64(instance_t *instance, const reference_t *references, size_t n,
                             int64_t *values, size_t n_values) {
  status_t status = check_sizes(instance, n, n_values);
  for (size_t k = 0; k < n && status == OK; k++) {
    double value = 0.0;
    status = get(instance, references[k], CS_INTEGER, &value);
    values[k] = (int64_t)value;
  }
  return status;
}

EXPORT status_t fmi3GetBoolean(instance_t *instance, const reference_t *references, size_t n,
                               bool *values, size_t n_values) {
  status_t status = check_sizes(instance, n, n_values);
  for (size_t k = 0; k < n && status == OK; k++) {
    double value = 0.0;
    status = get(instance, references[k], CS_BOOLEAN, &value);
    values[k] = value != 0.0;
  }
  return status;
}

EXPORT status_t fmi3SetFloat64(instance_t *instance, const reference_t *references, size_t n,
                               const double *values, size_t n_values) {
  status_t status = check_sizes(instance, n, n_values);
  for (size_t k = 0; k < n && status == OK; k++)
    status = set(instance, references[k], CS_REAL, values[k]);
  return status;
}

EXPORT status_t fmi3SetBoolean(instance_t *instance, const reference_t *references, size_t n,
                               const bool *values, size_t n_values) {
  status_t status = check_sizes(instance, n, n_values);
  for (size_t k = 0; k < n && status == OK; k++)
    status = set(instance, references[k], CS_BOOLEAN, values[k]);
  return status;
}

/* State of the unit: a copy of the instance's memory */

typedef struct {
  mode_t3 mode;
  _Alignas(16) unsigned char bench[];
} saved_t;

static size_t saved_size(void) { return sizeof(saved_t) + cs_size(); }

EXPORT status_t fmi3GetFMUState(instance_t *instance, saved_t **state) {
  if (!*state) *state = malloc(saved_size());
  if (!*state) return report(instance, ERROR, "out of memory");
  (*state)->mode = instance->mode;
  memcpy((*state)->bench, instance->bench, cs_size());
  return OK;
}

EXPORT status_t fmi3SetFMUState(instance_t *instance, const saved_t *state) {
  if (!state) return report(instance, ERROR, "FMUState: must not be null");
  instance->mode = state->mode;
  memcpy(instance->bench, state->bench, cs_size());
  return OK;
}

EXPORT status_t fmi3FreeFMUState(instance_t *instance, saved_t **state) {
  (void)instance;
  free(*state);
  *state = NULL;
  return OK;
}

EXPORT status_t fmi3SerializedFMUStateSize(instance_t *instance, const void *state, size_t *size) {
  (void)instance, (void)state;
  *size = saved_size();
  return OK;
}

EXPORT status_t fmi3SerializeFMUState(instance_t *instance, const saved_t *state,
                                      unsigned char *bytes, size_t size) {
  if (size != saved_size())
    return report(instance, ERROR, "size = %zu: must be %zu", size, saved_size());
  memcpy(bytes, state, size);
  return OK;
}

EXPORT status_t fmi3DeserializeFMUState(instance_t *instance, const unsigned char *bytes,
                                        size_t size, saved_t **state) {
  if (size != saved_size())
    return report(instance, ERROR, "size = %zu: must be %zu", size, saved_size());
  if (!*state) *state = malloc(size);
  if (!*state) return report(instance, ERROR, "out of memory");
  memcpy(*state, bytes, size);
  return OK;
}

/* Functions of the standard that a unit without such variables or abilities never needs; FMI asks
   for their symbols. */

#define ABSENT(name)                                                    \
  EXPORT status_t name(instance_t *instance) {                          \
    return report(instance, ERROR, #name ": this unit does not have it"); \
  }

#define ABSENT_TYPE(type) ABSENT(fmi3Get##type) ABSENT(fmi3Set##type)

ABSENT_TYPE(Float32)
ABSENT_TYPE(Int8)
ABSENT_TYPE(UInt8)
ABSENT_TYPE(Int16)
ABSENT_TYPE(UInt16)
ABSENT_TYPE(Int32)
ABSENT_TYPE(UInt32)
ABSENT_TYPE(UInt64)
ABSENT_TYPE(String)
ABSENT_TYPE(Binary)
ABSENT_TYPE(Clock)
ABSENT_TYPE(IntervalDecimal)
ABSENT_TYPE(IntervalFraction)
ABSENT_TYPE(ShiftDecimal)
ABSENT_TYPE(ShiftFraction)
ABSENT(fmi3SetInt64)
ABSENT(fmi3EnterEventMode)
ABSENT(fmi3EnterStepMode)
ABSENT(fmi3EnterConfigurationMode)
ABSENT(fmi3ExitConfigurationMode)
ABSENT(fmi3EvaluateDiscreteStates)
ABSENT(fmi3UpdateDiscreteStates)
ABSENT(fmi3GetNumberOfVariableDependencies)
ABSENT(fmi3GetVariableDependencies)
ABSENT(fmi3GetDirectionalDerivative)
ABSENT(fmi3GetAdjointDerivative)
ABSENT(fmi3GetOutputDerivatives)
ABSENT(fmi3ActivateModelPartition)
ABSENT(fmi3CompletedIntegratorStep)
ABSENT(fmi3EnterContinuousTimeMode)
ABSENT(fmi3GetContinuousStateDerivatives)
ABSENT(fmi3GetContinuousStates)
ABSENT(fmi3GetEventIndicators)
ABSENT(fmi3GetNominalsOfContinuousStates)
ABSENT(fmi3GetNumberOfContinuousStates)
ABSENT(fmi3GetNumberOfEventIndicators)
ABSENT(fmi3SetContinuousStates)
ABSENT(fmi3SetTime)

#define NO_SUCH_INSTANCE(name) \
  EXPORT void *name(void) { return NULL; }

NO_SUCH_INSTANCE(fmi3InstantiateModelExchange)
NO_SUCH_INSTANCE(fmi3InstantiateScheduledExecution)
