"""How exact the default run is on random benches: shared by the tests and by a benchmark.

Errors are those of the coordinates in metres, angles counted by their arm: against the same
engine at rtol 1e-12, or, for both of these, against the independent model of maximal_model.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from maximal_model import MaximalBench, MaximalRun

from capture_sim import SimulationError, simulate
from capture_sim.dynamics.samples import EventKind
from capture_sim.run.run import Run
from capture_sim.scene.parts import Scene

DEFAULT, TIGHT = 1e-8, 1e-12
#: s after the first touch at which errors are looked at; estimates look at all times before.
AFTER = np.array([0.1, 0.35, 1.0])
GRID = np.arange(0.0, 1.0001, 5e-3)
AT = np.searchsorted(GRID[1:], AFTER - 1e-9)
RTOLS = (1e-6, 1e-8, 1e-10)


def arms(scene: Scene) -> np.ndarray:
    """Metres per unit of each coordinate."""
    front = scene.buffer.hinge_offset + scene.rest_length
    return np.array([1.0, 1.0, front, front, 1.0, 1.0, 1.0, scene.cone.L_T + scene.cone.R_c])


def run(
    scene: Scene, times: np.ndarray, rtol: float, method: str = "dop853", check: bool = False
) -> Run:
    settings = replace(scene.run, rtol=rtol, method=method, t_end=float(times[-1]) + 1e-3)
    return simulate(replace(scene, run=settings), t_eval=times, check=check)


def difference(one: Run, other: Run | MaximalRun) -> np.ndarray:
    """Largest difference of two runs at each time (n,), m."""
    return (np.abs(one.q - other.q) * arms(one.scene)).max(axis=1)


def sequence(result: Run | MaximalRun, end: float = np.inf) -> list[tuple[bool, int]]:
    """Whether it is a touch and its wall, of every touch and lift-off before ``end``, in order."""
    if isinstance(result, Run):
        touches = [
            (event.t, event.kind is EventKind.TOUCH, event.wall)
            for event in result.events
            if event.kind in (EventKind.TOUCH, EventKind.LIFT_OFF)
        ]
    else:
        touches = [(touch.start, True, touch.side) for touch in result.touches]
        touches += [(touch.end, False, touch.side) for touch in result.touches]
    return [(begins, wall) for t, begins, wall in sorted(touches) if t < end]


def residual(result: Run) -> float:
    """Largest energy residual of a run, of its largest kinetic energy."""
    energy = result.energy
    return float(np.abs(energy["energy_residual"]).max() / energy["kinetic"].max())


@dataclass
class Measured:
    """What is true of a run, and what its check says."""

    error: np.ndarray  # largest up to each of AFTER, m
    peak: float  # relative error of the largest force
    wrong: bool  # the touch sequence is not the exact one
    estimate: np.ndarray | None = None  # of the error, as the check has it
    flagged: bool = False  # the check says that the touch sequence is in doubt
    on_floor: bool = False


def measure(found: Run, exact: Run | MaximalRun) -> Measured:
    """Measure a run at ``first_touch + GRID[1:]`` against a more exact one."""
    end = float(found.t[-1])
    if isinstance(exact, Run):
        largest = exact.touches["peak_force"].max()
    else:
        largest = max(touch.peak for touch in exact.touches)
    measured = Measured(
        error=np.maximum.accumulate(difference(found, exact))[AT],
        peak=abs(found.touches["peak_force"].max() / largest - 1.0),
        wrong=sequence(found, end) != sequence(exact, end),
        on_floor=found.scene.supports is not None,
    )
    if found.check is None:
        return measured
    flagged = not found.check.same_touches
    return replace(measured, estimate=found.check.error[AT], flagged=flagged)


def first_touch(scene: Scene) -> float | None:
    """Time of the first touch within a second, s."""
    start = simulate(replace(scene, run=replace(scene.run, t_end=1.0, state_rate=100.0)))
    return next((event.t for event in start.events if event.kind is EventKind.TOUCH), None)


def against_itself(scene: Scene) -> Measured:
    """Measure the default run against the same engine at TIGHT."""
    touch = first_touch(scene)
    assert touch is not None
    times = touch + GRID[1:]
    return measure(run(scene, times, DEFAULT, check=True), run(scene, times, TIGHT))


def residual_ratios(scene: Scene) -> Iterator[float]:
    """3 |energy residual| / E_0 by the error in tip radii at 0.4 s, for each of RTOLS."""
    times = np.arange(0.0, 0.4, 5e-3)
    exact = run(scene, times, 1e-12)
    for rtol in RTOLS:
        found = run(scene, times, rtol)
        yield 3.0 * residual(found) * scene.probe.tip_radius / difference(found, exact).max()


def against_the_model(scene: Scene) -> tuple[Measured, Measured] | None:
    """Measure the runs at DEFAULT and TIGHT against the independent model.

    None where no wall is met, or the model ends before.
    """
    try:
        touch = first_touch(scene)
        if touch is None:
            return None
        times = touch + GRID[1:]
        default, tight = run(scene, times, DEFAULT, check=True), run(scene, times, TIGHT)
    except SimulationError:
        return None
    model = MaximalBench(scene, 0.0, *scene.initial_coordinates(), rtol=1e-12, atol=1e-14)
    exact = model.advance(times.tolist())
    return measure(default, exact), measure(tight, exact)
