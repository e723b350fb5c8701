"""The programs that are compared: each integrates the paper's case at several tolerances."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from benchmarks.engines import cvode, floor, own, scipy_ivp
from benchmarks.reference import load_reference
from benchmarks.trial import Outcome, Prepare, Progress, Trial, run_rounds
from capture_sim.dynamics.engine.step_length import error_scale
from capture_sim.scene.parts import Scene

#: Speed of the approach, m/s: an error of an event's time as a length.
_SPEED = 0.1
_LEAST_RTOL = 2.5e-14  # SciPy takes none below 100 times the rounding unit
_DECADES = tuple(10.0**-k for k in range(3, 11))
OURS = "capture_sim"


class Level(NamedTuple):
    """Largest errors of a run that counts: in position (m or rad) and in event times (s)."""

    position: float
    event_time: float


#: In the time error, the chaser moves by the position error.
LEVELS = tuple(Level(error, error / _SPEED) for error in (1e-6, 1e-8, 1e-9))


@dataclass(frozen=True)
class Plan:
    """What is run to one end time."""

    t_end: float  # s
    rtols: tuple[float, ...] = _DECADES
    #: SciPy's methods, and that with equations in NumPy, each with its tolerances.
    scipy: tuple[str, ...] = ("DOP853", "LSODA")
    numpy: tuple[float, ...] = (1e-4, 1e-6, 1e-8)
    rounds: int = 11
    allowed: float = 5.0  # s, of one run


FULL = (
    Plan(0.35, scipy=scipy_ivp.METHODS),
    Plan(1.5, numpy=()),
)
QUICK = (Plan(0.35, rtols=(1e-4, 1e-6, 1e-9), numpy=(1e-6,), rounds=3),)


@dataclass(frozen=True)
class Contest:
    """All trials to one end time."""

    plan: Plan
    touches: int  # of the reference
    trials: list[Trial]


def measure(scene: Scene, plan: Plan, progress: Progress) -> Contest:
    """Run everything in a plan, in turn."""
    truth = load_reference(scene.name, scene).at(plan.t_end)
    scene = own.with_run(scene, t_end=plan.t_end)
    trials: list[Trial] = []

    def add(program: str, group: str, rtol: float, job: Prepare) -> None:
        trials.append(Trial(program, f"rtol {rtol:.0e}", job, group, truth))

    trials += own_trials(scene, plan, truth)
    for rtol in plan.rtols:
        changed = own.with_run(scene, rtol=rtol)
        add("bare C++ loop", "floor", rtol, functools.partial(floor.prepare, changed))
    for method in cvode.METHODS if cvode.version() else ():
        for rtol in plan.rtols:
            changed = own.with_run(scene, rtol=rtol)
            job = functools.partial(cvode.prepare, changed, method)
            add(f"CVODE {method}", "library", rtol, job)
    for method in plan.scipy:
        for rtol in plan.rtols:
            add(f"SciPy {method}", "python", rtol, scipy_job(scene, "compiled", method, rtol, plan))
    for rtol in plan.numpy:
        job = scipy_job(scene, "numpy", "LSODA", rtol, plan)
        add("SciPy LSODA, NumPy equations", "numpy", rtol, job)
    run_rounds(trials, plan.rounds, progress, f"programs to {plan.t_end:g} s")
    touches = 0 if truth.touches is None else truth.touches.size
    return Contest(plan, touches, trials)


def own_trials(scene: Scene, plan: Plan, truth: Outcome) -> Iterator[Trial]:
    """Yield this package's integrators at the tolerances of a plan."""
    for method in ("dop853", "dopri5"):
        for rtol in plan.rtols:
            job = functools.partial(own.prepare, own.with_run(scene, method=method, rtol=rtol))
            yield Trial(f"{OURS} {method}", f"rtol {rtol:.0e}", job, "own", truth)


def compiled(scene: Scene) -> Iterator[Prepare]:
    """Yield a short run of each program that is compiled."""
    scene = own.with_run(scene, t_end=1e-4)
    yield functools.partial(own.prepare, scene)
    yield functools.partial(floor.prepare, scene)
    yield scipy_job(scene, "compiled", "LSODA", 1e-4, QUICK[0])
    for method in cvode.METHODS if cvode.version() else ():
        yield functools.partial(cvode.prepare, scene, method)


def scipy_job(scene: Scene, group: str, method: str, rtol: float, plan: Plan) -> Prepare:
    """Return what prepares a run of SciPy, with the error weights of this package."""
    y_0 = np.concatenate(scene.initial_coordinates())
    constants = own.packed(scene)[0]
    weights = error_scale(constants)[:16] / float(constants["rtol"])
    options = {"method": method, "rtol": _LEAST_RTOL, "atol": rtol * weights}
    return functools.partial(scipy_ivp.prepare, scene, group, y_0, plan.allowed, options)


def programs(trials: Iterable[Trial]) -> dict[str, list[Trial]]:
    """Return the trials of each program, loose to tight."""
    found: dict[str, list[Trial]] = {}
    for trial in trials:
        found.setdefault(trial.family, []).append(trial)
    return found


def best(trials: Sequence[Trial], level: Level) -> Trial | None:
    """Return the fastest of a program's settings that meets a level; None if none does.

    ``trials`` come from loose to tight.  An error may be small by chance, so all tighter settings
    must meet the level too.
    """
    counted: list[Trial] = []
    for trial in reversed([trial for trial in trials if trial.seconds]):
        if not meets(trial, level):
            break
        counted.append(trial)
    return min(counted, key=lambda trial: trial.least, default=None)


def meets(trial: Trial, level: Level) -> bool:
    """Return True for a run with the reference's touches and errors within a level."""
    # the time error of other touches is NaN
    found = trial.errors
    return found.position <= level.position and found.event_time <= level.event_time


def at_level(trials: Iterable[Trial], level: Level) -> Iterator[tuple[str, Trial | None]]:
    """Yield each program with its fastest setting that meets a level."""
    for program, own_trials in programs(trials).items():
        yield program, best(own_trials, level)


def miscounted(trials: Iterable[Trial]) -> dict[str, list[Trial]]:
    """Return the settings of each program whose touches are not those of the reference."""
    return {
        program: [t for t in tried if t.seconds and math.isnan(t.errors.event_time)]
        for program, tried in programs(trials).items()
    }
