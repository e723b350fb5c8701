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
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene
from capture_sim.simulation import Result

DEFAULT, TIGHT = 1e-8, 1e-12
#: s after the first touch at which errors are looked at; estimates look at all times before.
AFTER = np.array([0.1, 0.35, 1.0])
GRID = np.arange(0.0, 1.0001, 5e-3)
AT = np.searchsorted(GRID, AFTER - 1e-9)
RTOLS = (1e-6, 1e-8, 1e-10)


def arms(scene: Scene) -> np.ndarray:
    """Metres per unit of each coordinate."""
    front = scene.buffer.hinge_offset + scene.rest_length
    return np.array([1.0, 1.0, front, front, 1.0, 1.0, 1.0, scene.cone.L_T + scene.cone.R_c])


def run(
    scene: Scene, times: np.ndarray, rtol: float, method: str = "dop853", check: bool = False
) -> Result:
    settings = replace(scene.run, rtol=rtol, method=method, t_end=float(times[-1]) + 1e-3)
    return simulate(replace(scene, run=settings), t_eval=times, check=check)


def difference(one: Result, other: Result) -> np.ndarray:
    """Largest difference of two runs at each time (n,), m."""
    return (np.abs(one.q - other.q) * arms(one.scene)).max(axis=1)


def sequence(result: Result) -> list[tuple[EventKind, int]]:
    """Kind and wall of every touch and lift-off, in order."""
    kinds = (EventKind.TOUCH, EventKind.LIFT_OFF)
    return [(event.kind, event.wall) for event in result.events if event.kind in kinds]


def sequence_until(result: Result | MaximalRun, end: float) -> list[tuple[bool, int]]:
    """Whether it is a touch and its wall, of every touch and lift-off before ``end``, in order."""
    if isinstance(result, Result):
        touches = [
            (event.t, event.kind is EventKind.TOUCH, event.wall)
            for event in result.events
            if event.kind in (EventKind.TOUCH, EventKind.LIFT_OFF)
        ]
    else:
        touches = [(touch.start, True, touch.side) for touch in result.touches]
        touches += [(touch.end, False, touch.side) for touch in result.touches]
    return [(begins, wall) for t, begins, wall in sorted(touches) if t < end]


def residual(result: Result) -> float:
    """Largest energy residual of a run, of its largest kinetic energy."""
    energy = result.energy
    return float(np.abs(energy["energy_residual"]).max() / energy["kinetic"].max())


@dataclass
class Measured:
    """One bench: what is true of the default run, and what its check says."""

    error: np.ndarray  # largest up to each of AFTER, m
    estimate: np.ndarray  # likewise, as the check has it
    peak: float  # relative error of the largest force
    wrong: bool  # the touch sequence is not the reference's
    flagged: bool  # the check says that the touch sequence is in doubt
    on_floor: bool


def first_touch(scene: Scene) -> float | None:
    """Time of the first touch within a second, s."""
    start = simulate(replace(scene, run=replace(scene.run, t_end=1.0, state_rate=100.0)))
    return next((event.t for event in start.events if event.kind is EventKind.TOUCH), None)


def measure(scene: Scene) -> Measured:
    touch = first_touch(scene)
    assert touch is not None
    default = run(scene, touch + GRID, DEFAULT, check=True)
    exact = run(scene, touch + GRID, TIGHT)
    forces = [result.touches["peak_force"].max() for result in (default, exact)]
    return Measured(
        error=np.maximum.accumulate(difference(default, exact))[AT],
        estimate=default.check.error[AT],
        peak=abs(forces[0] / forces[1] - 1.0),
        wrong=sequence(default) != sequence(exact),
        flagged=not default.check.same_touches,
        on_floor=scene.supports is not None,
    )


def residual_ratios(scene: Scene) -> Iterator[float]:
    """3 |energy residual| / E_0 by the error in tip radii at 0.4 s, for each of RTOLS."""
    times = np.arange(0.0, 0.4, 5e-3)
    exact = run(scene, times, 1e-12)
    for rtol in RTOLS:
        found = run(scene, times, rtol)
        yield 3.0 * residual(found) * scene.probe.tip_radius / difference(found, exact).max()


@dataclass
class Compared:
    """One bench against the independent model."""

    scene: Scene
    default: np.ndarray  # error at the default tolerance, largest up to each of AFTER, m
    tight: np.ndarray  # likewise at TIGHT
    peak: float  # relative error of the default's largest force
    wrong: bool  # the default's touch sequence is not the model's
    wrong_tight: bool  # nor is that at TIGHT
    flagged: bool  # the default's check says that the touch sequence is in doubt


def compare(scene: Scene) -> Compared | None:
    """Compare with the independent model; None where no wall is met, or the model ends before."""
    try:
        touch = first_touch(scene)
        if touch is None:
            return None
        times = touch + GRID[1:]
        default = run(scene, times, DEFAULT, check=True)
        tight = run(scene, times, TIGHT)
    except SimulationError:
        return None
    model = MaximalBench(scene, 0.0, *scene.initial_coordinates(), rtol=1e-12, atol=1e-14)
    exact = model.advance(times.tolist())
    errors = [
        np.maximum.accumulate((np.abs(found.q - exact.q) * arms(scene)).max(axis=1))[AT - 1]
        for found in (default, tight)
    ]
    sequences = [sequence_until(found, times[-1]) for found in (exact, default, tight)]
    peaks = [default.touches["peak_force"].max(), max(touch.peak for touch in exact.touches)]
    return Compared(
        scene,
        *errors,
        peak=abs(peaks[0] / peaks[1] - 1.0),
        wrong=sequences[1] != sequences[0],
        wrong_tight=sequences[2] != sequences[0],
        flagged=not default.check.same_touches,
    )
