"""A run with its touches resolved: run again from its scene, sampled where things happen."""

from __future__ import annotations

import numpy as np

from capture_sim.errors import CaptureSimError, SimulationError
from capture_sim.recording.measured_run import MeasuredRun
from capture_sim.simulation import Result, simulate
from capture_sim.viewing.source import ViewableRun

#: Samples over the length of each touch, and over a window that is asked for.
PER_TOUCH = 40
PER_WINDOW = 4000


def resolved(
    run: ViewableRun, window: tuple[float, float] | None = None, per_touch: int = PER_TOUCH
) -> Result:
    """Run a run's scene again and sample every touch by the integrator's dense output.

    Parameters
    ----------
    run
        With the scene that made it.
    window
        From when to when, s since the start: only this is returned, in some 4000 samples more.
        None keeps the whole run.
    per_touch
        Samples from the start to the end of each touch.

    Returns
    -------
    Result
        The same motion, touches and events as the run's.

    Raises
    ------
    CaptureSimError
        This version of the simulator gives other touches than the run has.
    """
    grid, touches = np.asarray(run.samples["t"]), run.touches
    start, end = (float(grid[0]), float(grid[-1])) if window is None else window
    times = [grid[(grid >= start) & (grid <= end)]]
    for touch in touches[(touches["end"] >= start) & (touches["start"] <= end)]:
        times.append(np.linspace(touch["start"], touch["end"], per_touch))
        times.append(touch["peak_time"][None])
    if window is not None:
        times.append(np.linspace(start, end, PER_WINDOW))
    wanted = np.unique(np.concatenate(times))
    wanted = wanted[(wanted >= start) & (wanted <= min(end, grid[-1]))]
    if not wanted.size:
        raise CaptureSimError(
            f"{run.scene.name}: no motion from {start:g} to {end:g} s; it lasts to {grid[-1]:g} s"
        )
    try:
        again = simulate(run.scene, t_eval=wanted)
    except SimulationError as error:
        if error.result is None:
            raise
        again = error.result
    if not _same(again.touches, touches):
        raise CaptureSimError(
            f"{run.scene.name}: this version of the simulator gives other touches than the run "
            "has; it can only be drawn as it was sampled"
        )
    return again


def resolved_or_not(run: ViewableRun) -> ViewableRun:
    """Return the run resolved, or as it is where it cannot be run again as it was."""
    if not np.isfinite(run.samples["kinetic"]).any():
        return run  # measured
    try:
        return resolved(run)
    except CaptureSimError:
        return run


def cut(run: ViewableRun, window: tuple[float, float]) -> MeasuredRun:
    """Return a run that cannot be run again with its samples in a window, s, alone.

    Raises
    ------
    CaptureSimError
        It has none there.
    """
    t = run.samples["t"]
    inside = run.samples[(t >= window[0]) & (t <= window[1])]
    if not inside.size:
        raise CaptureSimError(
            f"{run.scene.name}: no sample from {window[0]:g} to {window[1]:g} s; it has samples "
            f"from {t[0]:g} to {t[-1]:g} s"
        )
    return MeasuredRun(run.scene, inside, run.touches, run.events, run.statuses)


def _same(touches: np.ndarray, others: np.ndarray) -> bool:
    """Tell whether two runs have the same touches, to 1 us."""
    return len(touches) == len(others) and bool(
        np.array_equal(touches["wall"], others["wall"])
        and np.allclose(touches["start"], others["start"], rtol=0.0, atol=1e-6)
    )
