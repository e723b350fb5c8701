"""Reads one recorded run, of the suite's nodes or of a real bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from capture_sim.detection.criteria import CaptureStatus
from capture_sim.dynamics.samples import Event, Extremes
from capture_sim.errors import RecordingError
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    CAPTURE_CRITERIA,
    CAPTURE_STATUS,
    CONTACT_TRACE,
)
from capture_sim.plausibility.check import rules_among
from capture_sim.plausibility.measured import Measured
from capture_sim.plausibility.motion import MeasuredMotion
from capture_sim.recording.bag import Bag, read_bag
from capture_sim.recording.evidence import evidence_in
from capture_sim.recording.export import tables_of
from capture_sim.recording.measurements import (
    commanded_launch,
    live_conditions,
    received_in,
    series_of,
    without_zero,
)
from capture_sim.run.given import Given
from capture_sim.run.lazy import Deferred
from capture_sim.run.origin import Origin
from capture_sim.run.run import ExactRun, MeasuredRun, Run
from capture_sim.run.series import SeriesBySource
from capture_sim.run.verdict import LiveConditions, Received
from capture_sim.scene.launch_plan import LaunchPlan
from capture_sim.scene.loading import as_scene
from capture_sim.scene.parts import Detector, Scene


def read_run(
    path: Path | str,
    *,
    scene: Scene | str | Path | None = None,
    remaps: Mapping[str, str] | None = None,
    release: float | None = None,
    trial: int | None = None,
) -> Run:
    """Read a recorded run: an MCAP or .db3 file or a bag's folder, of the suite or of a real bench.

    Parameters
    ----------
    path
        The file or folder.
    scene
        Scene of the run, its name or its file; None for the recorded one.
    remaps
        Recorded names of topics by the bench's names, e.g.
        ``{"chaser/odom": "/mocap/rb1/odom"}``, in addition to those that the recorder has noted.
    release
        Release time, s after the first pose; None to find it.
    trial
        Number of the trial to read, counted from 1, if several are in one recording.

    Returns
    -------
    Run
        The run, with the attributes of one that :func:`capture_sim.simulate` returns.  Topics are
        decoded at their first use.  A truncated or damaged file is read up to the damage;
        ``problems`` reports it.

    Raises
    ------
    RecordingError
        The file cannot be read, is of another kind or contains several runs, a topic of
        ``remaps`` is not in it, or ``release`` is outside of it.
    SceneError
        The recorded scene is invalid in this version, or there is no such scene.

    Warnings
    --------
    If ``run.doubts`` or ``run.problems`` is not empty, the measurements are not plausible or not
    complete; reading raises for neither.  ``run.waived`` names the rules that were not checked,
    because the trial has waived them.

    See Also
    --------
    capture_sim.simulate : The run of a scene, of the same kind.
    capture_sim.calibrate : Fit a scene to several recorded runs.

    Examples
    --------
    A simulated run is recorded, and read again:

    >>> from tempfile import TemporaryDirectory
    >>> from capture_sim import read_run, simulate
    >>> from capture_sim.recording.offline import write_run
    >>> made = simulate("tilt_0")
    >>> with TemporaryDirectory() as folder:
    ...     read = read_run(write_run(made, f"{folder}/tilt_0.mcap"))
    ...     read.verdict, read.samples.tobytes() == made.samples.tobytes()
    ('captured', True)
    """
    known = None if scene is None else as_scene(scene)
    return run_of(read_bag(path, remaps=remaps, release=release, trial=trial), known)


def run_of(bag: Bag, scene: Scene | None = None) -> Run:
    """Return the run in a recording that was read before.

    ``scene`` as in :func:`read_run`.  Rules that the trial has waived are waived here, too.
    RecordingError if there are several runs; SceneError if the recorded scene is invalid in this
    version.
    """
    if len(bag.run_ids) > 1:
        raise RecordingError(f"{bag.path}: contains {len(bag.run_ids)} runs: must be one run")
    sha256 = ""
    if scene is None and bag.has_scene:
        scene, sha256 = bag.scene, bag.metadata.get("scene_sha256", "")

    return (ExactRun if bag.holds(BENCH_STATE) else MeasuredRun)(
        bag.name,
        GivenByBag(bag, scene),
        _origin_of(bag, sha256),
        wall_time=bag.wall_time,
        waived=() if bag.announced is None else rules_among(bag.announced.waived),
    )


class GivenByBag(Given):
    """The data of a run that its recording gives; a topic is decoded when it is first read.

    Samples, touches, events, statuses, criteria and trace are taken from topics of the bench.  A
    topic that has such a name but another type in the file counts as not recorded.
    """

    def __init__(self, bag: Bag, scene: Scene | None) -> None:
        super().__init__(scene=scene, tables=tables_of(bag))
        self._bag = bag
        self._has_own_series = True

    @cached_property
    def series(self) -> SeriesBySource:
        """Series by quantity and source; the zero of a rig's buffer at rest is subtracted."""
        return without_zero(series_of(self._bag), Deferred(self._motion))

    def replaced(self, **values: Any) -> GivenByBag:
        """Return a copy with some properties replaced; another scene shows another zero."""
        changed = super().replaced(**values)
        if "series" in values:
            changed._has_own_series = False
        elif "scene" in values and self._has_own_series:
            vars(changed).pop("series", None)
        return changed

    def _motion(self) -> MeasuredMotion | None:
        return MeasuredMotion(self.evidence[0], self.scene) if self.evidence else None

    @cached_property
    def samples(self) -> np.ndarray:
        """Recorded BenchStates, (n,) of dtype SAMPLE."""
        return self._bag.samples if self._bag.holds(BENCH_STATE) else super().samples

    @cached_property
    def touches(self) -> np.ndarray:
        """Touches that the recorded BenchEvents describe, (n,) of dtype TOUCH."""
        return self._bag.touches if self._bag.holds(BENCH_EVENT) else super().touches

    @cached_property
    def events(self) -> Sequence[Event]:
        """Recorded BenchEvents, in the order of recording."""
        return self._bag.events if self._bag.holds(BENCH_EVENT) else super().events

    @cached_property
    def received(self) -> Sequence[Received]:
        """Measurements in the order in which the live detector received them."""
        return received_in(self._bag, self.scene)

    @cached_property
    def live(self) -> LiveConditions:
        """Conditions of the evaluation by the live detector."""
        return live_conditions(self._bag)

    @cached_property
    def statuses(self) -> Sequence[CaptureStatus]:
        """Recorded statuses of the live detector, in order."""
        return self._bag.statuses if self._bag.holds(CAPTURE_STATUS) else super().statuses

    @cached_property
    def criteria(self) -> Detector | None:
        """Recorded criteria of the live detector; None if not recorded."""
        return self._bag.criteria if self._bag.holds(CAPTURE_CRITERIA) else super().criteria

    @cached_property
    def extremes(self) -> Extremes | None:
        """Recorded extremes of strokes, torsion and forces; None if not recorded."""
        return self._bag.extremes

    @cached_property
    def trace(self) -> np.ndarray:
        """Recorded state of the contact at the integrator's steps, (n,) of dtype TRACE."""
        return self._bag.trace if self._bag.holds(CONTACT_TRACE) else super().trace

    @cached_property
    def plan(self) -> LaunchPlan | None:
        """Launch plan with the mass and drop height that the launcher commanded; None without."""
        return commanded_launch(self._bag, self.scene)

    @cached_property
    def evidence(self) -> Sequence[Measured]:
        """Measurements of poses, buffer and force, as the rules of plausibility read them."""
        return evidence_in(self._bag)


def _origin_of(bag: Bag, scene_sha256: str) -> Origin:
    return Origin(
        path=str(bag.path),
        scene_sha256=scene_sha256,
        recorded_software=tuple(filter(None, bag.metadata.get("software", "").split("\n"))),
        release=bag.clock.origin,
        after_first_pose=bag.clock.after_first_pose,
        problems=bag.problems,
        left_out=bag.left_out,
    )
