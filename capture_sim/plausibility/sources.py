"""Rules of sources: does each topic carry measurements, and until the end?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from capture_sim.plausibility.measured import Poses
from capture_sim.plausibility.motion import MIN_MESSAGES, N_SMOOTH, MeasuredMotion
from capture_sim.plausibility.rules import Grade, Said, rule
from capture_sim.plausibility.signals import smooth

#: A source that ends earlier than the others by this has stopped, s.
MAX_SILENCE = 0.5
#: A source has a gap if two of its measurements are further apart than this, s.
_GAP = 0.75
#: ... and by this many of its intervals.
_MIN_INTERVALS = 20
#: A pause between two trials, s, and how much further apart the vehicles are after it, m.
_PAUSE, _BACK = 2.0, 0.05
#: Least number of equal poses that stand.
_STANDS = 50
#: Ratio of two rates of a source above which its rate has changed.
_RATE_RATIO = 1.7
#: Least number of messages in a third of a recording to measure a rate.
_MIN_THIRD = 20


@rule(
    "no_pose",
    Grade.REFUSED,
    compares="orientation and position of each pose of a vehicle",
    threshold="numbers not finite, or norm of the quaternion < 0.001: these poses are left out; "
    "refused if all are",
    reason="an orientation has norm 1; drivers send zeros or NaN for a body that the cameras do "
    "not see",
)
def no_pose(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each vehicle with messages that lack a pose."""
    for name, poses in motion.measured.vehicles:
        lost = int((~poses.is_measured).sum())
        if lost == poses.count:
            what = "quaternion 0 0 0 0" if (poses.norm < 1e-3).any() else "not finite"
            yield Said(
                poses.topic,
                f"{name} never tracked: all {lost} poses have {what}; define the rigid body and "
                "check its markers",
            )
        elif lost:
            text = f"{lost} of {poses.count} messages hold no pose (a quaternion of norm 0, or NaN)"
            yield Said(poses.topic, f"{text}: check the tracking", lost, grade=Grade.LEFT_OUT)


@rule(
    "poses_stand",
    Grade.REFUSED,
    compares="every pose of a vehicle with the one before",
    threshold=f"all of {_STANDS} or more are equal to the last bit, while the other vehicle's "
    "have noise, or the chaser's while the buffer shows a contact; a target's is noted as long as "
    "nothing has met it; not checked before a release",
    reason="cameras measure with noise; a driver repeats the last pose of a body that it lost",
    needs=("poses",),
)
def poses_stand(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each vehicle whose pose never changes although it is measured."""
    if motion.measured.is_before_release:
        return
    stands = {name: _stands(poses) for name, poses in motion.measured.vehicles}
    is_noisy = any(_is_noisy(poses) for _, poses in motion.measured.vehicles)
    has_met = "buffer" in motion.contacts
    for name, poses in motion.measured.vehicles:
        if stands[name] and (is_noisy or (has_met and stands.get("chaser", False))):
            hint = (
                "" if name == "chaser" else ", or waive the rule if its pose is given, not measured"
            )
            yield Said(
                poses.topic,
                f"{name} never moves, and its pose has no noise: all {poses.count} must be "
                f"measurements; check the tracking{hint}",
                # a target that nothing has met may stand
                grade=None if has_met or name == "chaser" else Grade.NOTED,
            )


def _stands(poses: Poses) -> bool:
    values = poses.values[poses.is_measured]
    return len(values) >= _STANDS and bool((values == values[0]).all())


def _is_noisy(poses: Poses) -> bool:
    """Return True if nearly all poses differ from the one before in x, y and heading."""
    if poses.is_measured.sum() < _STANDS:
        return False
    changes = np.diff(poses.planar, axis=0) != 0.0
    return bool((changes.all(axis=1)).mean() > 0.9)


@rule(
    "no_value",
    Grade.LEFT_OUT,
    compares="stroke and torsion, or force, of each message",
    threshold="not finite",
    reason="NaN is no measurement",
)
def no_value(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for buffer and load cell if some or all of their values are not finite."""
    for channel, what in (
        (motion.measured.buffer, "position of buffer_slide or buffer_hinge"),
        (motion.measured.force, "force"),
    ):
        if channel is None or not channel.count:
            continue
        lost = int((~channel.is_measured).sum())
        if lost == channel.count:
            yield Said(
                channel.topic,
                f"all {lost} messages have a {what} that is not finite: check the driver",
            )
        elif lost:
            yield Said(
                channel.topic,
                f"{lost} of {channel.count} messages have a {what} that is not finite",
                lost,
            )


@rule(
    "no_joints",
    Grade.LEFT_OUT,
    compares="joints of each message with buffer_slide and buffer_hinge",
    threshold="no message has both",
    reason="the position of the tip needs both",
)
def no_joints(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if no message of the buffer's topic has a state of the buffer."""
    buffer = motion.measured.buffer
    if buffer is not None and buffer.unused and not buffer.count:
        yield Said(buffer.topic, buffer.unused)


@rule(
    "few_messages",
    Grade.LEFT_OUT,
    compares="number of messages of a source",
    threshold=f"fewer than {MIN_MESSAGES}, and another source has ten times as many",
    reason="noise and motion cannot be known from fewer",
)
def few_messages(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each source with far fewer messages than another source.

    A source without any message is not reported.
    """
    most = max((channel.count for channel in motion.measured.channels), default=0)
    for channel in motion.measured.channels:
        if channel.count < MIN_MESSAGES and most >= 10 * channel.count + MIN_MESSAGES:
            yield Said(
                channel.topic,
                f"messages: {channel.count}, where another source has {most}: must be "
                f"{MIN_MESSAGES} or more; check the driver's rate and its quality of service",
            )


@rule(
    "ends_early",
    Grade.NOTED,
    compares="last message of a source with the last of the others",
    threshold=f"earlier by > {MAX_SILENCE} s and > {_MIN_INTERVALS} intervals",
    reason="longer than an occlusion at the contact (0.5 s)",
)
def ends_early(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each source whose messages end before those of another source.

    The ends are compared by arrival, or by stamp where the arrivals are not known.  Sources with
    fewer than ``MIN_MESSAGES`` messages are ignored.
    """
    channels = [c for c in motion.measured.channels if c.count >= MIN_MESSAGES]
    if len(channels) < 2 or motion.measured.is_before_release:  # there, ages are checked
        return
    ends = [float(channel.logged.max()) for channel in channels]
    for channel, end in zip(channels, ends, strict=True):
        early = max(ends) - end
        if early > MAX_SILENCE and early > _MIN_INTERVALS * _interval(channel.logged):
            yield Said(
                channel.topic,
                f"last message {early:.2f} s before that of the other sources: the source has "
                "stopped; nothing is known of it from there",
            )


@rule(
    "gap",
    Grade.NOTED,
    compares="time between two measurements of a source, before its last one",
    threshold=f"> {_GAP} s and > {_MIN_INTERVALS} intervals; not checked before a release",
    reason="longer than an occlusion at the contact (0.5 s); what happens in a gap, e.g. a first "
    "contact, gets the time of its end",
)
def gap(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each source with a gap: its longest one."""
    if motion.measured.is_before_release:
        return
    for channel in motion.measured.channels:
        t = np.unique(channel.t[channel.is_measured])
        if len(t) < MIN_MESSAGES:
            continue
        steps = np.diff(t)
        limit = max(_GAP, _MIN_INTERVALS * float(np.median(steps)))
        if count := int((steps > limit).sum()):
            k = int(steps.argmax())
            begin, end = t[k] - t[0], t[k + 1] - t[0]
            which = "" if count == 1 else f" (longest of {count} gaps)"
            yield Said(
                channel.topic,
                f"no measurement from {begin:.2f} to {end:.2f} s after the first{which}: what "
                "happened meanwhile is not known, and counts from the end of the gap",
            )


@rule(
    "several_trials",
    Grade.NOTED,
    compares="distance between the vehicles after a pause of all sources with that before",
    threshold=f"pause > {_PAUSE:g} s, and further apart by > {1e3 * _BACK:g} mm",
    reason="a chaser is carried back for the next trial",
    needs=("poses",),
)
def several_trials(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the recording seems to hold several trials."""
    pair = motion.pair
    if pair is None or motion.measured.is_before_release:
        return
    t, distance = motion.smooth_times, smooth(motion.distance, N_SMOOTH)
    paused = np.flatnonzero((np.diff(t) > _PAUSE) & (np.diff(distance) > _BACK))
    if paused.size:
        begins = ", ".join(f"{t[k + 1] - t[0]:.2f}" for k in paused)
        yield Said(
            motion.pair_topic,
            f"{paused.size + 1} trials: one begins {begins} s after the first pose, further away "
            "than the one before ended; evaluated as one unless --trial N chooses one",
        )


@rule(
    "rate_changes",
    Grade.NOTED,
    compares="shortest usual interval (25th percentile) of a source in the first and in the last "
    "third of its messages",
    threshold=f"ratio > {_RATE_RATIO:g}; not checked before a release",
    reason="half of the rate is a ratio of 2; a driver's own rate varies by a few percent, and a "
    "busy machine delays or loses messages, but does not change their shortest interval",
)
def rate_changes(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each source whose rate has about doubled or halved.

    The rates are those of the stamps.
    """
    if motion.measured.is_before_release:  # two seconds tell nothing of a rate
        return
    for channel in motion.measured.channels:
        third = channel.count // 3
        if third < _MIN_THIRD:
            continue
        first, last = (
            float(np.percentile(np.diff(np.unique(t)), 25.0)) if len(np.unique(t)) > 1 else 0.0
            for t in (channel.t[:third], channel.t[-third:])
        )
        if min(first, last) > 0.0 and max(first, last) > _RATE_RATIO * min(first, last):
            yield Said(
                channel.topic,
                f"{1.0 / first:.4g} Hz at the begin, {1.0 / last:.4g} Hz at the end: must be "
                "one rate; check the load of the driver's machine",
            )


def _interval(t: np.ndarray) -> float:
    """Return the typical time between messages with the times ``t`` (n,), s; 0 if n < 2.

    It is the median interval.  If messages come in clumps, most intervals are near 0, and the mean
    interval is returned instead.
    """
    if len(t) < 2:
        return 0.0
    ordered = np.sort(t)
    median = float(np.median(np.diff(ordered)))
    mean = float(ordered[-1] - ordered[0]) / (len(t) - 1)
    return median if median > 0.3 * mean else mean
