/* One scene of capture_sim in C.

   The integrator is the one of the Python package, compiled. It needs no Python and allocates
   nothing: the caller provides the memory of an instance. Instances share nothing that is written,
   so each may run in its own thread. Times are in s since the release; values are in SI units.

   Use: cs_begin, cs_set for parameters, cs_advance to 0, then cs_advance to each next time.

   With the parameter contact_outside set to 1, the cone's walls do not act. The inputs, a wrench on
   the tip about its centre in the axes of target/cone, act in their place until the latch closes. */
#ifndef CAPTURE_SIM_BENCH_H
#define CAPTURE_SIM_BENCH_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct cs_bench cs_bench;

typedef enum { CS_REAL = 0, CS_INTEGER = 1, CS_BOOLEAN = 2 } cs_type;

/* A number of the bench with its unit; a parameter has a default and a range as well. */
typedef struct {
  const char *name;
  const char *unit;
  const char *meaning; /* in words; empty if the name is enough */
  cs_type type;
  const char *range; /* as text; NULL for inputs and outputs */
  double start;
  double low, high; /* a parameter's range */
  int low_open, high_open;
} cs_variable;

/* How cs_advance or cs_set ended. */
typedef enum {
  CS_OK = 0,
  CS_EVENT = 1,    /* stopped at an event before the time asked for */
  CS_ENDED = 2,    /* the run is over: run.t_end, or run.after_latch after the latch closed */
  CS_FAILED = 3,   /* the run cannot continue; cs_message gives the reason */
  CS_REJECTED = 4, /* a value or time is not allowed; cs_message gives the reason */
} cs_result;

/* Bytes of an instance, to be aligned as malloc aligns. */
size_t cs_size(void);

/* Begin a run in this memory; NULL if this processor lacks instructions of the library. */
cs_bench *cs_begin(void *memory);

const char *cs_scene(void);

size_t cs_parameter_count(void);
const cs_variable *cs_parameter(size_t index);
/* Set a parameter; only before the first cs_advance. */
cs_result cs_set(cs_bench *bench, size_t index, double value);
double cs_get(const cs_bench *bench, size_t index);

/* None for a scene with supports. */
size_t cs_input_count(void);
const cs_variable *cs_input(size_t index);
/* Set an input, which keeps its value from the present time until it is set again. */
cs_result cs_put(cs_bench *bench, size_t index, double value);
double cs_given(const cs_bench *bench, size_t index);

/* Continue to time t, which must not be before the present one.

   With stop_at_events, stop at the first event after the present time; outputs are then those just
   before the event. The detector's outputs are those of its latest sample, at a multiple of
   1 / run.rate. */
cs_result cs_advance(cs_bench *bench, double t, int stop_at_events);

double cs_time(const cs_bench *bench);
size_t cs_output_count(void);
const cs_variable *cs_output(size_t index);
double cs_read(const cs_bench *bench, size_t index);

/* Reason of the last CS_FAILED or CS_REJECTED. */
const char *cs_message(const cs_bench *bench);

#ifdef __cplusplus
}
#endif
#endif
