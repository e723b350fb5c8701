/* A host that advances a bench by 1 ms every millisecond: how late it wakes, how long a step takes.

   Arguments: number of steps, priority of SCHED_FIFO (0: the ordinary scheduler). Prints a line with
   both in us for each step. */
#define _GNU_SOURCE
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

#include "bench.h"

static double seconds(const struct timespec *t) { return t->tv_sec + 1e-9 * t->tv_nsec; }

int main(int count, char **arguments) {
  int n = count > 1 ? atoi(arguments[1]) : 10000, priority = count > 2 ? atoi(arguments[2]) : 0;
  struct sched_param parameter = {.sched_priority = priority};
  struct timespec due, woken, done;
  double *late = calloc(n, sizeof *late), *step = calloc(n, sizeof *step);
  cs_bench *bench = cs_begin(malloc(cs_size()));
  if (!bench || !late || !step) return fputs("no bench\n", stderr), 1;
  if (priority && sched_setscheduler(0, SCHED_FIFO, &parameter))
    return perror("SCHED_FIFO"), 3;
  mlockall(MCL_CURRENT | MCL_FUTURE);
  clock_gettime(CLOCK_MONOTONIC, &due);
  for (int k = 0; k < n; k++) {
    due.tv_nsec += 1000000;
    if (due.tv_nsec >= 1000000000) due.tv_sec++, due.tv_nsec -= 1000000000;
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
    clock_gettime(CLOCK_MONOTONIC, &woken);
    if (cs_advance(bench, k * 0.001, 0) != CS_OK) return fputs(cs_message(bench), stderr), 1;
    clock_gettime(CLOCK_MONOTONIC, &done);
    late[k] = seconds(&woken) - seconds(&due);
    step[k] = seconds(&done) - seconds(&woken);
  }
  for (int k = 0; k < n; k++) printf("%.3f %.3f\n", late[k] * 1e6, step[k] * 1e6);
  return 0;
}
