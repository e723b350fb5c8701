"""Reading of one recorded run, of the suite or of a real bench."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from capture_sim.errors import RecordingError
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    CAPTURE_CRITERIA,
    CAPTURE_STATUS,
    CONTACT_TRACE,
    Topic,
)
from capture_sim.recording.bag import Bag, read_bag
from capture_sim.recording.evidence import evidence_in
from capture_sim.recording.export import tables_of
from capture_sim.recording.measurements import (
    commanded_launch,
    live_conditions,
    received_in,
    series_of,
)
from capture_sim.run.lazy import Deferred
from capture_sim.run.origin import Origin
from capture_sim.run.run import Run
from capture_sim.scene.parts import Scene


def read_run(
    path: Path | str,
    *,
    scene: Scene | None = None,
    remaps: Mapping[str, str] | None = None,
    release: float | None = None,
) -> Run:
    """Read a recorded run: an MCAP or .db3 file or a bag's folder, of the suite or of a real bench.

    Parameters
    ----------
    path
        The file or folder.
    scene
        Scene of the run; None for the recorded one.
    remaps
        Recorded names of topics by the bench's names, e.g.
        ``{"chaser/odom": "/mocap/rb1/odom"}``, in addition to those that the recorder has noted.
    release
        Release time, s after the first pose; None to find it.

    Returns
    -------
    Run
        The run as :func:`capture_sim.simulate` returns it.  Topics are decoded at their first use.
        A truncated or damaged file is read up to the damage; ``problems`` reports it.

    Raises
    ------
    RecordingError
        The file cannot be read, is of another kind or contains several runs, a topic of
        ``remaps`` is not in it, or ``release`` is outside of it.
    SceneError
        The recorded scene is invalid in this version.
    """
    return run_of(read_bag(path, remaps=remaps, release=release), scene)


def run_of(bag: Bag, scene: Scene | None = None) -> Run:
    """Return the run in a bag; see :func:`read_run`."""
    if len(bag.run_ids) > 1:
        raise RecordingError(f"{bag.path}: contains {len(bag.run_ids)} runs: must be one run")
    sha256 = ""
    if scene is None and bag.has_scene:
        scene, sha256 = bag.scene, bag.metadata.get("scene_sha256", "")

    def of_topic(topic: Topic, name: str) -> Deferred[Any] | None:
        """Return a property of the bag; None if a foreign topic has the name of ours."""
        return Deferred(partial(getattr, bag, name)) if bag.holds(topic) else None

    return Run(
        name=bag.name,
        origin=_origin_of(bag, sha256),
        given_scene=scene,
        state=of_topic(BENCH_STATE, "samples"),
        series=series_of(bag),
        located_touches=of_topic(BENCH_EVENT, "touches"),
        logged_events=of_topic(BENCH_EVENT, "events"),
        received=Deferred(partial(received_in, bag, scene)),
        reported_statuses=of_topic(CAPTURE_STATUS, "statuses"),
        criteria=of_topic(CAPTURE_CRITERIA, "criteria"),
        located_extremes=Deferred(partial(getattr, bag, "extremes")),
        trace=of_topic(CONTACT_TRACE, "trace"),
        plan=Deferred(partial(commanded_launch, bag, scene)),
        tables=tables_of(bag),
        wall_time=bag.wall_time,
        evidence=Deferred(partial(evidence_in, bag)),
    )


def _origin_of(bag: Bag, scene_sha256: str) -> Origin:
    return Origin(
        path=str(bag.path),
        scene_sha256=scene_sha256,
        software=tuple(filter(None, bag.metadata.get("software", "").split("\n"))),
        release=bag.clock.origin,
        after_first_pose=bag.clock.after_first_pose,
        live=Deferred(partial(live_conditions, bag)),
        problems=bag.problems,
        left_out=bag.left_out,
    )
