#include "bench.h"

#include <stdio.h>
#include <string.h>

#include "scene.h"

/* The compiled kernel, engine/loop.py: advance. Numba passes the result and an exception's place
   first; a status other than 0 is an exception, which no kernel raises. */
extern int capture_sim_advance(int64_t *count, void **exception, void *workspace,
                               const double *times, int64_t n_times, void *samples, void *trace,
                               int64_t n_trace);

struct cs_bench {
  _Alignas(16) unsigned char workspace[CS_WORKSPACE_SIZE];
  _Alignas(16) unsigned char saved[CS_STATE_SIZE]; /* the state before the present step */
  _Alignas(16) unsigned char sample[CS_SAMPLE_SIZE];
  double time;
  int has_started;
  char message[320];
};

static double *number(cs_bench *bench, size_t offset) {
  return (double *)(bench->workspace + offset);
}

static int64_t *integer(cs_bench *bench, size_t offset) {
  return (int64_t *)(bench->workspace + offset);
}

static int has_instructions(void) {
#if defined(__x86_64__) && defined(CS_NEEDS)
  __builtin_cpu_init();
#define CS_NEED(feature) \
  if (!__builtin_cpu_supports(feature)) return 0;
  CS_NEEDS
#endif
  return 1;
}

size_t cs_size(void) { return sizeof(cs_bench); }

cs_bench *cs_begin(void *memory) {
  cs_bench *bench = memory;
  if (!has_instructions()) return NULL;
  memset(bench, 0, sizeof *bench);
  memcpy(bench->workspace, cs_initial, sizeof cs_initial);
  return bench;
}

const char *cs_scene(void) { return CS_SCENE; }

size_t cs_parameter_count(void) { return CS_PARAMETER_COUNT; }

const cs_variable *cs_parameter(size_t index) { return &cs_parameters[index]; }

cs_result cs_set(cs_bench *bench, size_t index, double value) {
  const cs_variable *p = &cs_parameters[index];
  int is_above = p->low_open ? value > p->low : value >= p->low;
  int is_below = p->high_open ? value < p->high : value <= p->high;
  if (!(is_above && is_below) || value - value != 0.0) {
    snprintf(bench->message, sizeof bench->message, "%s = %.9g %s: must be %s", p->name, value,
             p->unit, p->range);
    return CS_REJECTED;
  }
  if (bench->has_started) {
    snprintf(bench->message, sizeof bench->message, "%s = %.9g %s: must be set before the release",
             p->name, value, p->unit);
    return CS_REJECTED;
  }
  for (int k = 0; k < CS_PLACES; k++)
    if (cs_places[index][k]) *number(bench, cs_places[index][k]) = value;
  if (cs_shapes_buffer[index]) *integer(bench, CS_HAS_SHAPED_BUFFER) = 1;
  return CS_OK;
}

double cs_get(const cs_bench *bench, size_t index) {
  return *number((cs_bench *)bench, cs_places[index][0]);
}

/* Run to time t and sample there; first_event receives the time of the first event after `after`. */
static cs_result run_to(cs_bench *bench, double t, double after, double *first_event) {
  for (;;) {
    int64_t count = 0;
    void *exception = NULL;
    *integer(bench, CS_N_LOG) = 0;
    if (capture_sim_advance(&count, &exception, bench->workspace, &t, 1, bench->sample, NULL, 0)) {
      snprintf(bench->message, sizeof bench->message, "the integrator raised an exception");
      return CS_FAILED;
    }
    for (int64_t k = 0; k < *integer(bench, CS_N_LOG); k++) {
      double t_event = *number(bench, CS_LOG + k * CS_EVENT_SIZE + CS_EVENT_TIME);
      if (t_event > after && t_event < *first_event) *first_event = t_event;
    }
    int64_t status = *integer(bench, CS_STATUS);
    if (status == CS_STATUS_INTERRUPTED) continue;
    if (status != CS_STATUS_SERVED) {
      snprintf(bench->message, sizeof bench->message, "%s: stopped at t = %.9g s: %s", CS_SCENE,
               *number(bench, CS_STEP_START), cs_causes[status]);
      return CS_FAILED;
    }
    return count ? CS_OK : CS_ENDED;
  }
}

cs_result cs_advance(cs_bench *bench, double t, int stop_at_events) {
  double event = CS_NEVER;
  cs_result result;
  if (!(t >= bench->time) || t - t != 0.0) {
    snprintf(bench->message, sizeof bench->message,
             "time = %.9g s: must be finite and >= %.9g, the present time", t, bench->time);
    return CS_REJECTED;
  }
  bench->has_started = 1;
  memcpy(bench->saved, bench->workspace, CS_STATE_SIZE);
  result = run_to(bench, t, bench->time, &event);
  if (result == CS_OK && stop_at_events && event < t) {
    /* Once more from before, up to the event: the integrator has gone past it. */
    memcpy(bench->workspace, bench->saved, CS_STATE_SIZE);
    result = run_to(bench, event, event, &event);
    if (result == CS_OK) result = CS_EVENT;
  } else if (result == CS_ENDED) {
    /* Once more from before, up to the end, which is known only now if the latch has closed. */
    double end = *number(bench, CS_T_STOP);
    memcpy(bench->workspace, bench->saved, CS_STATE_SIZE);
    result = run_to(bench, end, end, &event);
    if (result == CS_OK) result = CS_ENDED;
  }
  if (result != CS_FAILED) bench->time = *(double *)(bench->sample + CS_SAMPLE_TIME);
  return result;
}

double cs_time(const cs_bench *bench) { return bench->time; }

size_t cs_output_count(void) { return CS_OUTPUT_COUNT; }

const cs_variable *cs_output(size_t index) { return &cs_outputs[index]; }

double cs_read(const cs_bench *bench, size_t index) {
  const unsigned char *place = bench->sample + cs_output_places[index];
  return cs_outputs[index].is_integer ? (double)*(const int64_t *)place : *(const double *)place;
}

const char *cs_message(const cs_bench *bench) { return bench->message; }
