#include "bench.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "scene.h"

/* Times that are not farther apart are one, s: those of a host are sums of steps. */
#define CS_SAME_TIME 1e-11

/* The compiled kernel, dynamics/engine/loop.py: advance. Numba passes the result and an exception's place
   first; a status other than 0 is an exception, which no kernel raises. */
extern int capture_sim_advance(int64_t *count, void **exception, void *workspace,
                               const double *times, int64_t n_times, void *samples, void *trace,
                               int64_t n_trace);

/* fmu/machine_code.py: detect, over the compiled criteria of detection/exact.py. */
extern int capture_sim_detect(int64_t *state, void **exception, const double *criteria, void *memory,
                              const void *sample, double *y, void *row, int64_t is_end);

/* What the detector keeps of a run. */
typedef struct {
  _Alignas(16) unsigned char memory[CS_MEMORY_SIZE];
  int64_t n_samples; /* at multiples of 1 / CS_RATE */
  int64_t is_over;
} detector_t;

struct cs_bench {
  _Alignas(16) unsigned char workspace[CS_WORKSPACE_SIZE];
  detector_t detector;
  /* both before the present step */
  _Alignas(16) unsigned char saved_workspace[CS_STATE_SIZE];
  detector_t saved_detector;
  _Alignas(16) unsigned char sample[CS_SAMPLE_SIZE];
  double time;
  double end; /* of a run with the contact outside */
  int has_started;
  unsigned char is_set[CS_PARAMETER_COUNT]; /* parameters, by the host */
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
  memcpy(bench->detector.memory, cs_memory, sizeof cs_memory);
  bench->end = *number(bench, CS_T_STOP);
  return bench;
}

const char *cs_scene(void) { return CS_SCENE; }

size_t cs_parameter_count(void) { return CS_PARAMETER_COUNT; }

const cs_variable *cs_parameter(size_t index) { return &cs_parameters[index]; }

/* A place that another parameter has been set for keeps its value, in whatever order a host sets them. */
static int is_of_another(const cs_bench *bench, size_t index, size_t place) {
  for (size_t k = 0; k < CS_PARAMETER_COUNT; k++)
    if (k != index && bench->is_set[k] && cs_places[k][0] == place) return 1;
  return 0;
}

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
  for (int k = 0; k < CS_PLACES; k++) {
    if (!cs_places[index][k] || is_of_another(bench, index, cs_places[index][k])) continue;
    if (p->type == CS_REAL)
      *number(bench, cs_places[index][k]) = value;
    else
      *integer(bench, cs_places[index][k]) = (int64_t)value;
  }
  bench->is_set[index] = 1;
  if (cs_shapes_buffer[index]) *integer(bench, CS_HAS_SHAPED_BUFFER) = 1;
  return CS_OK;
}

double cs_get(const cs_bench *bench, size_t index) {
  size_t place = cs_places[index][0];
  return cs_parameters[index].type == CS_REAL ? *number((cs_bench *)bench, place)
                                              : (double)*integer((cs_bench *)bench, place);
}

size_t cs_input_count(void) { return CS_INPUT_COUNT; }

const cs_variable *cs_input(size_t index) { return &cs_inputs[index]; }

cs_result cs_put(cs_bench *bench, size_t index, double value) {
  if (value - value != 0.0) {
    snprintf(bench->message, sizeof bench->message, "%s = %.9g %s: must be finite",
             cs_inputs[index].name, value, cs_inputs[index].unit);
    return CS_REJECTED;
  }
  *number(bench, cs_input_places[index]) = value;
  return CS_OK;
}

double cs_given(const cs_bench *bench, size_t index) {
  return *number((cs_bench *)bench, cs_input_places[index]);
}

static int is_driven(const cs_bench *bench) { return *integer((cs_bench *)bench, CS_DRIVEN) != 0; }

/* A bench with inputs pauses at each communication point. */
static int has_inputs(const cs_bench *bench) {
  return is_driven(bench) || *integer((cs_bench *)bench, CS_THRUSTING) != 0;
}

/* Run to time t and sample there; first_event receives the time of the first event after `after`. */
static cs_result run_to(cs_bench *bench, double t, double after, double *first_event) {
  /* a bench with inputs closes its last step only when it is asked for more */
  const double times[] = {t, CS_NEVER};
  int n_times = has_inputs(bench) && t >= *number(bench, CS_T_STOP) ? 2 : 1;
  for (;;) {
    int64_t count = 0;
    void *exception = NULL;
    *integer(bench, CS_N_LOG) = 0;
    if (capture_sim_advance(&count, &exception, bench->workspace, times, n_times, bench->sample,
                            NULL, 0)) {
      snprintf(bench->message, sizeof bench->message, "the integrator raised an exception");
      return CS_FAILED;
    }
    for (int64_t k = 0; k < *integer(bench, CS_N_LOG); k++) {
      size_t entry = CS_LOG + k * CS_EVENT_SIZE;
      double t_event = *number(bench, entry + CS_EVENT_TIME);
      if (t_event > after && t_event < *first_event) *first_event = t_event;
      if (*integer(bench, entry + CS_EVENT_KIND) == CS_EVENT_LATCHED &&
          t_event + *number(bench, CS_AFTER_LATCH) < bench->end)
        bench->end = t_event + *number(bench, CS_AFTER_LATCH);
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

static void detect(cs_bench *bench, int is_end) {
  int64_t state = 0;
  void *exception = NULL;
  double y[16];
  _Alignas(16) unsigned char row[CS_ROW_SIZE];
  capture_sim_detect(&state, &exception, cs_criteria, bench->detector.memory, bench->sample, y, row,
                     is_end);
}

/* Run to time t with the detector at its own times on the way. */
static cs_result follow_to(cs_bench *bench, double t, double after, double *first_event) {
  if (has_inputs(bench)) {
    *number(bench, CS_T_STOP) = t;
    *integer(bench, CS_EQUATIONS_CHANGED) = 1;
  }
  for (;;) {
    double due = bench->detector.n_samples / CS_RATE;
    int is_at_end = fabs(due - t) < CS_SAME_TIME;
    cs_result result = run_to(bench, due < t && !is_at_end ? due : t, after, first_event);
    if (result != CS_OK || (due > t && !is_at_end)) return result;
    detect(bench, 0);
    bench->detector.n_samples++;
    if (is_at_end) return result;
  }
}

static void save(cs_bench *bench) {
  memcpy(bench->saved_workspace, bench->workspace, CS_STATE_SIZE);
  bench->saved_detector = bench->detector;
}

static void go_back(cs_bench *bench) {
  memcpy(bench->workspace, bench->saved_workspace, CS_STATE_SIZE);
  bench->detector = bench->saved_detector;
}

static cs_result start(cs_bench *bench) {
  for (int k = 0; !is_driven(bench) && k < CS_TIP_INPUT_COUNT; k++) {
    if (cs_given(bench, k) == 0.0) continue;
    snprintf(bench->message, sizeof bench->message,
             "%s = %.9g %s: must be 0 unless contact_outside is true", cs_inputs[k].name,
             cs_given(bench, k), cs_inputs[k].unit);
    return CS_REJECTED;
  }
  if (is_driven(bench) && !bench->has_started)
    for (int k = 0; k < CS_WORD_COUNT; k++)
      memcpy(bench->workspace + cs_words[k].place, &cs_words[k].word, sizeof cs_words[k].word);
  bench->has_started = 1;
  return CS_OK;
}

cs_result cs_advance(cs_bench *bench, double t, int stop_at_events) {
  double event = CS_NEVER, before = bench->time;
  int is_first = !bench->has_started;
  cs_result result;
  if (!(t >= before) || t - t != 0.0) {
    snprintf(bench->message, sizeof bench->message,
             "time = %.9g s: must be finite and >= %.9g, the present time", t, before);
    return CS_REJECTED;
  }
  if (start(bench) != CS_OK) return CS_REJECTED;
  if (bench->detector.is_over) return CS_ENDED;
  if (has_inputs(bench) && t == before && !is_first) return CS_OK;
  save(bench);
  result = follow_to(bench, t < bench->end ? t : bench->end, before, &event);
  if (result == CS_OK && bench->end <= t) result = CS_ENDED;
  if (result != CS_FAILED && stop_at_events && event < t) {
    /* Once more from before, up to the event: the integrator has gone past it. */
    go_back(bench);
    result = follow_to(bench, event, event, &event);
    if (result == CS_OK) result = CS_EVENT;
  } else if (result == CS_ENDED) {
    /* Once more from before, up to the end, which is known only now if the latch has closed. */
    double end = has_inputs(bench) ? bench->end : *number(bench, CS_T_STOP);
    go_back(bench);
    result = follow_to(bench, end, end, &event);
    if (result == CS_OK) {
      result = CS_ENDED;
      detect(bench, 1);
      bench->detector.is_over = 1;
    }
  }
  if (result != CS_FAILED) bench->time = *(double *)(bench->sample + CS_SAMPLE_TIME);
  return result;
}

double cs_time(const cs_bench *bench) { return bench->time; }

size_t cs_output_count(void) { return CS_OUTPUT_COUNT; }

const cs_variable *cs_output(size_t index) { return &cs_outputs[index]; }

/* Closest approach so far: of the integrator's steps, before and after the latch, up to the start of
 * the present one, and of the detector's samples and the latest one, which may be in it. */
static double nearest_distance(const cs_bench *bench) {
  double nearest = *(const double *)(bench->sample + CS_TIP_DISTANCE);
  double sampled = *(const double *)(bench->detector.memory + CS_NEAREST_PLACE - CS_SAMPLE_SIZE);
  double before = fabs(*number((cs_bench *)bench, CS_NEAREST_BEFORE));
  double after = fabs(*number((cs_bench *)bench, CS_NEAREST_AFTER));
  if (sampled < nearest) nearest = sampled;
  if (before < nearest) nearest = before;
  return *integer((cs_bench *)bench, CS_LATCHED) && after < nearest ? after : nearest;
}

double cs_read(const cs_bench *bench, size_t index) {
  size_t offset = cs_output_places[index];
  if (offset == CS_NEAREST_PLACE) return nearest_distance(bench);
  const unsigned char *place = offset < CS_SAMPLE_SIZE
                                   ? bench->sample + offset
                                   : bench->detector.memory + (offset - CS_SAMPLE_SIZE);
  return cs_outputs[index].type == CS_REAL ? *(const double *)place : (double)*(const int64_t *)place;
}

const char *cs_message(const cs_bench *bench) { return bench->message; }
