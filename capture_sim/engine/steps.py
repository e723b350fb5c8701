"""One accepted step, explicit or implicit, and how long it may be."""

from __future__ import annotations

import math

from capture_sim.engine.distances import way_to_events
from capture_sim.engine.notebook import (
    NO_EVENT,
    NOT_FINITE,
    SERVED,
    SMALLEST_STEP,
    STEP_TOO_SMALL,
    TOO_MANY_STEPS,
)
from capture_sim.kernels import kernel
from capture_sim.model.equations import N_STATE, N_TOTAL, STOP, rate_of_change, stiff_directions
from capture_sim.solver.radau import C as STAGE_TIMES
from capture_sim.solver.radau import factor_systems, make_implicit
from capture_sim.solver.runge_kutta import make_stepper, next_factor

_HELD_SHARE = 0.6  # of the longest step in contact
_CONTACT_ANGLE = 5.0  # rad of the contact's oscillation that a step may span

#: The states and the energies count in the error, the impulses do not.
N_WATCHED = STOP + 1

try_step, prepare_dense = make_stepper(rate_of_change, N_STATE, N_TOTAL, N_WATCHED)
derivatives, solve_step = make_implicit(rate_of_change, stiff_directions)


@kernel
def make_dense(par, run, mode, pair, y, y_s, K, F, scratch):
    """Prepare the dense output of the present step, once."""
    if not run.dense_ready:
        prepare_dense(par, mode, scratch, pair, run.t0, y, run.h, K, y_s, F)
        run.dense_ready = 1


@kernel
def step_length(par, run, mode):
    """Return the length of the next step and whether its error decides."""
    if par.fixed_step == 0.0:
        h = min(run.h_next, 1.01 * (run.t_stop - run.t0))
        if run.tip_speed > 0.0:
            h = min(h, way_to_events(par, run, mode) / run.tip_speed)
        for i in range(2):
            if mode.touching[i] and run.gap[i] < 0.0:
                # less than a period of the contact: a longer step may be right at its end and
                # far off in between, where samples and events are read
                stiffness = 1.5 * par.K * math.sqrt(-run.gap[i])
                longest = _CONTACT_ANGLE * math.sqrt(par.m_P / stiffness)
                if h > _HELD_SHARE * longest:
                    # an explicit step of this size is kept short by its stability
                    run.held_back += 1
                    h = min(h, longest)
                elif h < 0.3 * longest:
                    run.held_back = min(run.held_back, 0)
        return h
    # to the next multiple of the fixed step; what an event has cut off is caught up
    n = math.floor(run.t0 / par.fixed_step + 1.0 + 1e-9)
    if run.substeps == 0 or n * par.fixed_step - run.t0 > 0.999 * par.fixed_step:
        run.substeps = 0
    return n * par.fixed_step - run.t0


@kernel
def take_implicit_step(par, run, mode, y, y_new, y_s, K, F, weights, scratch, stages, work):
    """Take one accepted step of the implicit method; returns whether it could."""
    Z = work[8]
    h = min(run.h_stiff, 1.01 * (run.t_stop - run.t0))
    guess = run.h_last > 0.0
    fresh = False
    for _ in range(20):
        if not run.derived:
            run.evaluations += derivatives(
                par, mode, scratch, run.t0, y, K[0], y_s, 1e-10, 1e-7, work
            )
            run.derived = 1
            run.h_factored = 0.0
            fresh = True
        if h != run.h_factored:
            if not factor_systems(h, work):
                return False
            run.h_factored = h
        # first guess: the last step's cubic carried on, or the motion now
        for k in range(3):
            if guess:
                x = 1.0 + STAGE_TIMES[k] * h / run.h_last
                for i in range(N_STATE):
                    Z[k, i] = x * (F[0, i] + (1.0 - x) * (F[1, i] + x * F[2, i])) - F[0, i]
            else:
                tau = STAGE_TIMES[k] * h
                for i in range(8):
                    Z[k, i] = tau * (y[8 + i] + 0.5 * tau * K[0, 8 + i])
                    Z[k, 8 + i] = tau * K[0, 8 + i]
        iterations, rate, error = solve_step(
            par, mode, scratch, run.t0, y, K[0], h, y_s, y_new, K[stages], weights, work, F
        )
        run.evaluations += 3 * max(iterations, 1) + 1
        guess = False
        if iterations < 0:
            run.rejected += 1
            if fresh:
                h *= 0.3
            run.derived = 0
            run.h_last = 0.0
            continue
        # rounding in the linear systems must not move a vehicle that its supports hold
        for which in range(2):
            if (mode.rest_S if which == 0 else mode.rest_T) == 1:
                for i in range(5 * which, 5 * which + 3):
                    for j in (i, 8 + i):
                        y_new[j] = y[j]
                        K[stages, j] = 0.0
                        for k in range(F.shape[0]):
                            F[k, j] = 0.0
        factor = min(4.0, max(0.2, 0.85 * error**-0.25)) if error > 0.0 else 4.0
        if error > 1.0:
            run.rejected += 1
            h *= factor
            continue
        run.h_last = h
        run.h_stiff = h * factor
        if iterations > 3 or rate > 0.1:
            run.derived = 0
        run.steps += 1
        run.pending = NO_EVENT
        run.h = h
        run.t1 = run.t0 + h
        run.dense_ready = 1
        run.error = 1e-4
        return True
    return False


@kernel
def take_step(par, run, mode, pair, y, y_new, y_s, e_5, e_3, K, weights, scratch, h):
    """Take one accepted step of at most ``h``; returns the loop's status."""
    stages = pair[5]
    run.dense_ready = 0
    run.pending = NO_EVENT
    while True:
        if h < SMALLEST_STEP:
            if run.t_stop - run.t0 >= SMALLEST_STEP and par.fixed_step == 0.0:
                return STEP_TOO_SMALL
            h = SMALLEST_STEP
        error = try_step(par, mode, scratch, pair, run.t0, y, h, K, y_s, e_5, e_3, y_new, weights)
        run.evaluations += stages
        if par.fixed_step > 0.0:
            total = 0.0
            for i in range(N_STATE):
                total += y_new[i]
            if not math.isfinite(total):
                return NOT_FINITE
            break
        factor = next_factor(error, run.error, pair[6])
        if error <= 1.0:
            run.error = error
            run.h_next = h * factor
            break
        run.rejected += 1
        if not error < 1e300:
            for i in range(N_STATE):
                if not (math.isfinite(K[0, i]) and math.isfinite(y[i])):
                    return NOT_FINITE
            # what is not a number must not come back by way of a zero weight
            for j in range(1, K.shape[0]):
                for i in range(N_TOTAL):
                    K[j, i] = 0.0
        h *= min(factor, 1.0)
    run.steps += 1
    run.h = h
    run.t1 = run.t0 + h
    return TOO_MANY_STEPS if run.steps > par.max_steps else SERVED
