"""What several readers take off the bench's topics: stamps, headings, the release."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.messages.convert import EPOCH_NS, LaunchAction
from capture_sim.messages.topics import (
    BENCH_STATE,
    CHASER_ODOMETRY,
    CHASER_POSE,
    LAUNCH_COMMAND,
    RUN_INFO,
    TARGET_ODOMETRY,
    TARGET_POSE,
    Topic,
)

Columns = Mapping[str, np.ndarray]


class Recorded(Protocol):
    """A recording, as :class:`capture_sim.recording.Run`."""

    def columns(self, topic: str | Topic) -> Columns:
        """Return a topic's fields by path; empty without messages."""


def stamps_of(columns: Columns) -> np.ndarray:
    """Return the stamps of a topic's messages, (n,) int64, ns."""
    path = "clock" if "clock.sec" in columns else "header.stamp"
    stamps = np.asarray(columns[f"{path}.sec"]).astype(np.int64) * 1_000_000_000
    return stamps + np.asarray(columns[f"{path}.nanosec"]).astype(np.int64)


def headings_of(columns: Columns, at: str) -> np.ndarray:
    """Return the headings of the poses that stand at a path, (n,), rad."""
    z, w = (columns[f"{at}.orientation.{axis}"].tolist() for axis in "zw")
    # by math, as the detector's node does it: NumPy's differ in the last bit
    return 2.0 * np.array(list(map(math.atan2, z, w)))


def release_of(bag: Recorded, after: float | None = None) -> int:
    """Return the stamp of the release, ns: the launcher's, else that of simulated runs.

    Where neither is recorded, as on a bench whose clock is the wall's, the first pose's.

    Parameters
    ----------
    bag
        The recording.
    after
        s after the first pose, where it is known better; None where it is not.

    Raises
    ------
    RecordingError
        That is behind the last pose.
    """
    if after is not None:
        return _after_first_pose(bag, after)
    told = release_told(bag)
    if told is not None:
        return told
    stamps = _pose_stamps(bag)
    return EPOCH_NS if stamps is None else int(stamps.min())


def release_told(bag: Recorded) -> int | None:
    """Return the stamp of the release, ns, as the recording tells it; None where it does not."""
    commands = bag.columns(LAUNCH_COMMAND)
    if commands:
        released = np.flatnonzero(commands["action"] == LaunchAction.RELEASE)
        if released.size:
            return int(stamps_of(commands)[released[0]])
    return EPOCH_NS if bag.columns(RUN_INFO) or bag.columns(BENCH_STATE) else None


def _pose_stamps(bag: Recorded) -> np.ndarray | None:
    for topic in (CHASER_POSE, CHASER_ODOMETRY, TARGET_POSE, TARGET_ODOMETRY):
        if poses := bag.columns(topic):
            return stamps_of(poses)
    return None


def _after_first_pose(bag: Recorded, after: float) -> int:
    stamps = _pose_stamps(bag)
    if stamps is None:
        raise RecordingError(f"release = {after:g} s: counts from the first pose: there is none")
    first, last = int(stamps.min()), int(stamps.max())
    if not 0.0 <= after <= (last - first) / 1e9:
        raise RecordingError(
            f"release = {after:g} s: allowed is 0 to {(last - first) / 1e9:g} s, from the first "
            "pose to the last"
        )
    return first + round(after * 1e9)
