"""Error against wall time and evaluations: our integrators and SciPy's, on one scene."""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.engines import own as own_runs
from benchmarks.engines import scipy_ivp as scipy_runs
from benchmarks.pages import Spread
from benchmarks.reference import load_reference
from benchmarks.trial import STOPPED, Outcome, Progress, Trial, run_rounds
from capture_sim.bench import error_scale
from capture_sim.scene.parts import METHODS, Scene

#: Right-hand sides that are handed to SciPy, by group.
GROUP_NAMES = {"compiled": "compiled RHS", "numpy": "NumPy RHS"}

#: Absolute tolerances that users give to SciPy with the relative one: rtol / 1000 for every state;
#: or our own norm, rtol times each state's scale, with the relative part off.
FORMS = ("plain", "scaled")
_LEAST_RTOL = 2.5e-14  # SciPy takes none below 100 times the rounding unit
_DECADES = tuple(10.0**-k for k in range(3, 11))


@dataclass(frozen=True)
class Plan:
    """What is tried at one horizon."""

    t_end: float  # s
    #: Group of SciPy's integrators and position error (m or rad) to compare at.
    compared: tuple[tuple[str, float], ...]
    rtols: tuple[float, ...] = _DECADES  # of our adaptive integrators
    scipy_rtols: tuple[float, ...] = _DECADES  # of SciPy's, with the compiled right-hand side
    numpy_rtols: tuple[float, ...] = _DECADES[:7]  # ... and with the other one
    stiff_rtols: tuple[float, ...] = _DECADES  # out of these, of its implicit methods
    steps: tuple[float, ...] = (1e-4, 5e-5, 2e-5, 1e-5, 5e-6, 2e-6)  # s, of our fixed-step ones
    forms: tuple[str, ...] = FORMS
    scipy_methods: tuple[str, ...] = scipy_runs.METHODS
    rounds: int = 5
    allowed: float = 3.0  # s, of any one run; twice that with the NumPy right-hand side


FULL = (
    Plan(
        t_end=0.35,
        compared=(("compiled", 1e-6), ("compiled", 1e-9), ("numpy", 1e-6)),
    ),
    Plan(
        t_end=1.5,
        compared=(("compiled", 1e-8),),
        numpy_rtols=(1e-6, 1e-8),
        stiff_rtols=(1e-4, 1e-6, 1e-8),
        rounds=3,
        allowed=5.0,
    ),
)
QUICK = (
    replace(
        FULL[0],
        rtols=(1e-4, 1e-6, 1e-8),
        scipy_rtols=(1e-4, 1e-6),
        numpy_rtols=(1e-5,),
        stiff_rtols=(),
        steps=(2e-5,),
        forms=("scaled",),
        scipy_methods=("DOP853", "LSODA"),
        rounds=3,
    ),
)


@dataclass(frozen=True)
class Comparison:
    """The fastest of ours against the fastest of others at the same position error."""

    t_end: float  # s
    error: float  # m or rad
    group: str  # whose right-hand side SciPy had
    own: str
    rival: str
    own_seconds: float  # medians of the interpolated wall times
    rival_seconds: float
    ratio: Spread  # rival's time per ours over rounds; NaN where one never got as exact


@dataclass(frozen=True)
class WorkPrecision:
    """All trials at one horizon, and what they come to."""

    plan: Plan
    trials: list[Trial]
    comparisons: list[Comparison]


def measure(scene: Scene, plan: Plan, progress: Progress) -> WorkPrecision:
    """Run everything in a plan."""
    truth = load_reference(scene.name, scene).at(plan.t_end)
    scene = own_runs.with_run(scene, t_end=plan.t_end)
    own = list(own_trials(scene, plan, truth))
    rivals = list(scipy_trials(scene, plan, truth))
    for trial in own:  # once to warm up: branch predictors, caches, clock
        with suppress(*STOPPED):
            trial.prepare()[0]()
    stage = f"work and precision to {plan.t_end:g} s"
    run_rounds(own + rivals, plan.rounds, progress, stage)
    comparisons = [
        compare(own, [r for r in rivals if r.group == group], plan.t_end, error)
        for group, error in plan.compared
    ]
    return WorkPrecision(plan, own + rivals, comparisons)


def own_trials(scene: Scene, plan: Plan, truth: Outcome) -> Iterator[Trial]:
    """Yield our integrators at the settings of a plan, loose to tight."""
    for method in METHODS:
        fixed = own_runs.packed(own_runs.with_run(scene, method=method))[0]["fixed_step"] > 0.0
        for value in plan.steps if fixed else plan.rtols:
            change = {"step": value} if fixed else {"rtol": value}
            setting = f"step {value:g} s" if fixed else f"rtol {value:.0e}"
            changed = own_runs.with_run(scene, method=method, **change)
            job = functools.partial(own_runs.prepare, changed)
            yield Trial(method, setting, job, "own", truth)


def scipy_trials(scene: Scene, plan: Plan, truth: Outcome) -> Iterator[Trial]:
    """Yield SciPy's integrators at the settings of a plan, loose to tight."""
    y_0 = np.concatenate(scene.initial_coordinates())
    constants = own_runs.packed(scene)[0]
    scale = error_scale(constants)[:16] / float(constants["rtol"])
    for group, rtols in (("compiled", plan.scipy_rtols), ("numpy", plan.numpy_rtols)):
        allowed = plan.allowed * (2.0 if group == "numpy" else 1.0)
        for method in plan.scipy_methods:
            tried = [r for r in rtols if method not in ("BDF", "Radau") or r in plan.stiff_rtols]
            for form in plan.forms if group == "compiled" else ("scaled",):
                for rtol in tried:
                    plain = {"rtol": rtol, "atol": np.full(16, 1e-3 * rtol)}
                    scaled = {"rtol": _LEAST_RTOL, "atol": rtol * scale}
                    options = {"method": method} | (plain if form == "plain" else scaled)
                    job = functools.partial(scipy_runs.prepare, scene, group, y_0, allowed, options)
                    name = f"SciPy {method}, {GROUP_NAMES[group]}"
                    yield Trial(name, f"rtol {rtol:.0e} {form}", job, group, truth)


def families(trials: Iterable[Trial]) -> list[list[Trial]]:
    """Return trials that did not fail, by curve: family and form of the tolerance."""
    curves: dict[tuple[str, str], list[Trial]] = {}
    for trial in trials:
        if trial.seconds:
            form = trial.setting.rpartition(" ")[2]
            curves.setdefault((trial.family, form if form in FORMS else ""), []).append(trial)
    return list(curves.values())


def sure_errors(family: Sequence[Trial]) -> list[float]:
    """Return each trial's position error, or that of a tighter one if that is larger.

    An error may pass through zero by luck; settings come from loose to tight.
    """
    return np.maximum.accumulate([t.errors.position for t in family][::-1])[::-1].tolist()


def time_at(trials: Iterable[Trial], error: float, round_: int | None = None) -> float:
    """Return the least wall time (s) for a position error, over all curves; inf if none meets it.

    Between two settings it is interpolated on logarithmic axes.  ``round_`` takes the times of
    one round, None the medians.
    """
    return min((_time_on(family, error, round_) for family in families(trials)), default=math.inf)


def _time_on(family: Sequence[Trial], error: float, round_: int | None) -> float:
    sure = sure_errors(family)
    k = next((k for k, found in enumerate(sure) if found <= error), None)
    if k is None:
        return math.inf
    seconds = [
        t.median if round_ is None else t.seconds[min(round_, len(t.seconds) - 1)] for t in family
    ]
    exact = min(seconds[k:])
    if k == 0 or sure[k] <= 0.0:
        return exact
    loose, tight = math.log(sure[k - 1]), math.log(sure[k])
    share = (loose - math.log(error)) / (loose - tight)
    between = (1.0 - share) * math.log(seconds[k - 1]) + share * math.log(seconds[k])
    return min(exact, math.exp(between))


def compare(
    own: Sequence[Trial],
    rivals: Sequence[Trial],
    t_end: float,
    error: float,
) -> Comparison:
    """Compare the best of either side at the same error, round by round."""
    rounds = max((len(trial.seconds) for trial in own), default=0)
    ours = [time_at(own, error, k) for k in range(rounds)]
    theirs = [time_at(rivals, error, k) for k in range(rounds)]
    ratios = [b / a for a, b in zip(ours, theirs, strict=True) if math.isfinite(a + b)]
    return Comparison(
        t_end=t_end,
        error=error,
        group=rivals[0].group,
        own=_fastest(own, error),
        rival=_fastest(rivals, error),
        own_seconds=statistics.median(ours) if ours else math.inf,
        rival_seconds=statistics.median(theirs) if theirs else math.inf,
        ratio=Spread.of(ratios),
    )


def _fastest(trials: Sequence[Trial], error: float) -> str:
    best = min(families(trials), key=lambda family: _time_on(family, error, None), default=[])
    met = (t for t, sure in zip(best, sure_errors(best), strict=True) if sure <= error)
    trial = next(met, None)
    return f"{trial.family} near {trial.setting}" if trial else "none"
