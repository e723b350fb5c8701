"""The time of the release on each clock of a recording, and times since the release."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from capture_sim.errors import RecordingError
from capture_sim.messages.convert import EPOCH_NS, stamp_seconds
from capture_sim.run.origin import Release

#: A release whose stamp is further than this from its arrival, ns, is stamped by another clock.
_MAX_STAMP_DELAY = 1_000_000_000
#: Number of poses over which the difference of stamp and log time is averaged, by the median.
_N_OFFSETS = 20


class Logged(NamedTuple):
    """Messages of a topic by their stamps and their log times, (n,) int64 each, ns."""

    stamps: np.ndarray
    log_times: np.ndarray


class Clock(NamedTuple):
    """The time of the release, t = 0, on each clock of a recording.

    A recording has up to three clocks: that of the poses (of the simulator or the motion capture),
    that of the launcher and the trial's announcement, and that of the recorder (log times).
    """

    origin: Release
    release: int  # stamp by the clock of the poses, ns
    log_time: int  # when it was logged, or would have been, ns
    trial_release: int  # stamp by the clock of launcher and announcement, ns
    first_pose: int  # stamp of the first pose, ns; of the release without poses

    @property
    def t_release(self) -> float:
        """Value of the recorded field ``t`` at the release, s.

        This field, in messages with samples, events and the contact's trace, counts from a stamp of
        1 s.  It is thus 0 if the release has the stamp 1 s, as in a simulated run.
        """
        return stamp_seconds(self.release)

    @property
    def after_first_pose(self) -> float:
        """Time of the release, s after the first pose; 0 without poses."""
        return (self.release - self.first_pose) / 1e9

    def since(self, stamps: np.ndarray) -> np.ndarray:
        """Return stamps by the clock of the poses, ns, as times since the release, s."""
        return (stamps - self.release) / 1e9

    def since_by_trial(self, stamps: np.ndarray) -> np.ndarray:
        """Return stamps (n,), ns, that may be by two clocks, as times since the release, s.

        On a real bench a node stamps by the clock of the launcher and the announcement until it
        knows the clock of the poses, so a topic may have stamps by both.  Each stamp counts by the
        clock on which it is nearer to the release.  In a simulated run the clocks are the same.
        """
        is_trial = np.abs(stamps - self.trial_release) < np.abs(stamps - self.release)
        return (stamps - np.where(is_trial, self.trial_release, self.release)) / 1e9

    def since_by_log(self, log_times: np.ndarray) -> np.ndarray:
        """Return log times, ns, as times since the release, s."""
        return (log_times - self.log_time) / 1e9


def has_stamps(columns: Mapping[str, np.ndarray]) -> bool:
    """Return True if a topic's messages have a stamp: in a header, or a message of ``/clock``."""
    return "clock.sec" in columns or "header.stamp.sec" in columns


def stamps_of(columns: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the stamps of a topic's messages, (n,) int64, ns; see :func:`has_stamps`."""
    path = "clock" if "clock.sec" in columns else "header.stamp"
    stamps = np.asarray(columns[f"{path}.sec"]).astype(np.int64) * 1_000_000_000
    return stamps + np.asarray(columns[f"{path}.nanosec"]).astype(np.int64)


def find_clock(
    poses: Logged | None,
    release: Logged | None,
    begin: int,
    *,
    is_simulated: bool,
    given_release: float | None = None,
) -> Clock:
    """Find the release of a recording, see :attr:`capture_sim.recording.bag.Bag.clock`.

    Parameters
    ----------
    poses
        Messages with poses, of one topic; None if there are none.
    release
        The launcher's commands to release; if there are none, the announcements of the trial (the
        first message counts); None if there are neither.
    begin
        Earliest log time of all messages, ns.
    is_simulated
        True if a simulated run is recorded: the same clock then stamps all messages.
    given_release
        Release time, s after the first pose; None to find it.

    Raises
    ------
    RecordingError
        The given time is not between the first and the last pose, or there are no poses.
    """
    trial_release = EPOCH_NS if release is None else int(release.stamps[0])
    arrival = begin if release is None else int(release.log_times[0])
    if given_release is not None:
        found = find_clock(poses, release, begin, is_simulated=is_simulated)
        origin, stamp = Release.GIVEN, _after_first_pose(poses, given_release)
        trial_release += stamp - found.release  # the launcher's clock counts from the given one too
    elif is_simulated:
        origin, stamp = Release.STAMP, EPOCH_NS
    elif release is not None and poses is not None:
        stamp = arrival + _stamp_offset(poses, poses.log_times - arrival)
        origin = Release.ARRIVAL
        if abs(trial_release - stamp) <= _MAX_STAMP_DELAY:
            origin, stamp = Release.STAMP, trial_release
    elif release is not None:
        origin, stamp = Release.STAMP, trial_release
    else:
        origin, stamp = Release.BEGINNING, begin if poses is None else int(poses.stamps.min())
    if poses is None:
        return Clock(origin, stamp, arrival, trial_release, stamp)
    log_time = stamp - _stamp_offset(poses, poses.stamps - stamp)
    return Clock(origin, stamp, log_time, trial_release, int(poses.stamps.min()))


def _stamp_offset(poses: Logged, distances: np.ndarray) -> int:
    """Return the median of stamp minus log time, ns, over the poses nearest to the release.

    ``distances`` are the times of the poses from the release, (n,), ns.  Poses far from the release
    do not count, because the clock of a bench may run slow or fast.
    """
    nearest = np.argsort(np.abs(distances), kind="stable")[:_N_OFFSETS]
    return int(np.median((poses.stamps - poses.log_times)[nearest]))


def _after_first_pose(poses: Logged | None, t: float) -> int:
    """Return the stamp, ns, of a time t after the first pose, s.

    RecordingError if it is not between the first and the last pose, or if there are no poses.
    """
    if poses is None:
        raise RecordingError(
            f"release = {t:g} s: counts from the first pose, but no pose is recorded"
        )
    first, last = int(poses.stamps.min()), int(poses.stamps.max())
    if not 0.0 <= t <= (last - first) / 1e9:
        raise RecordingError(
            f"release = {t:g} s: must be 0 to {(last - first) / 1e9:g} s, from the first "
            "pose to the last"
        )
    return first + round(t * 1e9)
