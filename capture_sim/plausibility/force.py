"""Rules of the load cell: axes, sign, scale, drift, saturation, and forces without a contact."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from capture_sim.plausibility.axes import FORCE_FRAMES, frame_of
from capture_sim.plausibility.momentum import force_impulse
from capture_sim.plausibility.motion import MIN_MESSAGES, N_SMOOTH, MeasuredMotion
from capture_sim.plausibility.rules import Grade, Said, rule
from capture_sim.plausibility.signals import AWAY, noise, smooth

#: A drift of the sensor's zero is reported above these, N and N/s.
_DRIFT, _DRIFT_RATE = 1.0, 0.1
#: Before a release: largest zero of the sensor, N (newtons), largest change of the force from that
#: zero, N, and the time before the latest message in which both are measured, s.
MAX_ZERO, MAX_REST_FORCE, REST_TIME = 50.0, 3.0, 0.5
#: Saturation shows in this number of successive samples with the same largest value, or in that
#: value being reached this number of times.
_SATURATED, _TIMES = 4, 4
#: A cell is loaded if it shows this much more than at rest, N.
_LOADED = 1.0
#: A repeated value is one that comes this many times in a row.
_REPEATED = 2
#: A force that begins while the tip is further than this from the walls has another cause, m.
_FAR = 0.02
#: The two poses around the begin of the force must not be further apart than this, s.
_NEAR_TIME = 0.1
#: Bounds of the force's impulse over the chaser's change of momentum, which is about 1, and the
#: largest angle between them, rad.  Friction and sampling explain values within them.
_SMALL, _LARGE, _TURNED = 0.2, 5.0, math.radians(30.0)


@rule(
    "force_frame",
    Grade.LEFT_OUT,
    compares="header.frame_id of the force with the frames of the bench",
    threshold=f"not one of {', '.join(FORCE_FRAMES)}",
    reason="a force in unknown axes has no direction",
)
def force_frame(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the frame of the force is unknown, or if its messages name several."""
    force = motion.measured.force
    if force is not None and force.count and frame_of(force.frame_ids) is None:
        names = " and ".join(repr(name) for name in force.frame_ids)
        yield Said(force.topic, f"frame_id {names}: must be one, of {', '.join(FORCE_FRAMES)}")


@rule(
    "force_frame_empty",
    Grade.NOTED,
    compares="header.frame_id of the force with the empty text",
    threshold="empty",
    reason="the axes are not known; target/cone is assumed",
)
def force_frame_empty(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if no message of the force names a frame."""
    force = motion.measured.force
    if force is not None and force.count and not any(force.frame_ids):
        yield Said(
            force.topic,
            f"frame_id is empty: taken for target/cone; must be one of {', '.join(FORCE_FRAMES)}",
        )


@rule(
    "force_saturated",
    Grade.NOTED,
    compares="largest magnitude of a component with the samples beside it",
    threshold="4 samples in a row have it exactly, twice as many as repeat any other value, or it "
    "comes 4 times; or both components repeat, again and again, only in contact",
    reason="noise never repeats a largest value; a cell that always repeats samples repeats them "
    "without a contact too",
)
def force_saturated(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each of force.x and force.y that reaches the end of the cell's range."""
    force = motion.force
    if force is None:
        return
    kept = force.force[force.is_measured, :2]
    for axis, column in zip("xy", kept.T, strict=True):
        size = np.abs(column)
        largest = float(size.max())
        if largest <= max(1.0, 10.0 * noise(column)):
            continue
        rows = _rows(size == largest)
        in_row = int(rows.max(initial=0))
        others = size[size < largest]
        repeated = int(_rows(np.diff(others) == 0.0).max(initial=0)) + 1 if len(others) > 1 else 1
        if in_row >= max(_SATURATED, 2 * repeated if repeated > 1 else 0) or len(rows) >= _TIMES:
            yield Said(
                force.topic,
                f"force.{axis} is {largest:.5g} N at its largest {len(rows)} times, up to {in_row} "
                "samples in a row: the load cell is saturated; peaks and impulses are lower limits",
            )

    if _repeats_under_load(motion, kept):
        yield Said(
            force.topic,
            "the cell repeats its last value again and again, only in contact: it is saturated or "
            "loses samples; peaks and impulses are lower limits",
        )


def _repeats_under_load(motion: MeasuredMotion, values: np.ndarray) -> bool:
    """Return True if samples (n, 2) repeat the one before in contact, but not before it."""
    force, begin = motion.force, min(motion.contacts.values(), default=None)
    if force is None or begin is None:
        return False
    t = force.t[force.is_measured]
    is_before = t < begin - 0.05
    at_rest = np.median(values[is_before], axis=0) if is_before.any() else np.zeros(2)
    # a cell without noise repeats what it shows at rest
    is_loaded = np.hypot(*(values - at_rest).T) > _LOADED
    repeats = (np.diff(values, axis=0) == 0.0).all(axis=1)
    rows = _rows(repeats & is_loaded[1:] & ~is_before[1:])
    always = (repeats & is_before[1:] & (values[1:] != at_rest).any(axis=1)).any()
    return not always and int((rows >= _REPEATED - 1).sum()) >= _TIMES


def _rows(is_so: np.ndarray) -> np.ndarray:
    """Return the lengths of all series of successive True in ``is_so`` (n,) bool, as (k,) int."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], is_so.astype(np.int8), [0]])))
    return np.asarray(ends[1::2] - ends[::2])


@rule(
    "force_drifts",
    Grade.NOTED,
    compares="zero of the load cell at the begin and before the first contact, by the medians of "
    "the first and the last third of that time",
    threshold="differ by > 1 N, > 0.1 N/s and > 2 standard deviations",
    reason="0.05 N/s is a hard case of a warm-up, and is removed; 1 N is a tenth of a contact's "
    "mean force",
)
def force_drifts(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the load cell's zero drifts too far before the first contact."""
    force = motion.force
    if force is None:
        return
    kept = force.is_measured
    t, values = force.t[kept], force.force[kept, :2]
    limit = min(motion.contacts.values(), default=np.inf)
    if motion.scene is not None and motion.pair is not None and motion.stiff_gap[0] < AWAY:
        return  # it begins at the walls
    quiet = t < limit - 0.05
    if quiet.sum() < 100:
        return
    # medians of a third each: the first samples of a contact, which poses may show late, are few
    third = int(quiet.sum()) // 3
    begin, end = (
        np.median(values[quiet][part], axis=0) for part in (slice(third), slice(-third, None))
    )
    moved = 1.5 * (end - begin)
    scatter = max(noise(column) for column in values[quiet].T)
    duration = float(t[quiet][-1] - t[quiet][0])
    if float(np.hypot(*moved)) > max(_DRIFT, _DRIFT_RATE * duration, 2.0 * scatter):
        yield Said(
            force.topic,
            f"zero drifts by {np.hypot(*moved):.3g} N in {duration:.3g} s before the contact: must "
            "be below 1 N; touches are found without it, forces contain it; let the cell warm up",
        )


@rule(
    "force_at_rest",
    Grade.REFUSED,
    compares=f"before a release only: force in the last {REST_TIME:g} s with 0, and its running "
    "median with its zero, which is its median",
    threshold=f"zero > {MAX_ZERO:g} N; or off the zero by > {MAX_REST_FORCE:g} N and 3 standard "
    "deviations",
    reason="5 kg of a cone and its plate weigh 49 N; noise has a running median of a third of it, "
    "and a warm-up drifts by 0.02 N meanwhile; a hand or a cable at the cone is more",
)
def force_at_rest(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the load cell shows a force before a release, when nothing may touch it.

    It is checked only if ``Measured.is_before_release`` is True, on the last 0.5 s.  There the
    cell's zero is the median of each component.  A zero above 50 N (newtons) means that the cell
    was not tared.  A running median of nine samples that departs from the zero by more than 3 N and
    3 standard deviations means that something pushes the cone.  Both findings are possible.
    """
    force = motion.measured.force
    if force is None or not motion.measured.is_before_release:
        return
    latest = force.logged > force.logged.max(initial=0.0) - REST_TIME
    values = force.force[force.is_measured & latest]
    if len(values) < MIN_MESSAGES:
        return
    zero = np.median(values, axis=0)
    size = float(np.linalg.norm(zero))
    if size > MAX_ZERO:
        yield Said(
            force.topic,
            f"{size:.4g} N at rest: must be at most {MAX_ZERO:g} N before a release; tare the cell",
        )
    off = np.column_stack([smooth(column, N_SMOOTH) for column in (values - zero).T])
    pushed = float(np.linalg.norm(off, axis=1).max())
    if pushed > max(MAX_REST_FORCE, 3.0 * max(noise(column) for column in values.T)):
        yield Said(
            force.topic,
            f"changes by {pushed:.3g} N at rest: must be at most {MAX_REST_FORCE:g} N before a "
            "release; keep hands and cables off the cone",
        )


@rule(
    "force_without_contact",
    Grade.NOTED,
    compares="begin of the force with the distance of the tip to the walls by poses",
    threshold="> 20 mm and 6 standard deviations",
    reason="base frames and noise are below; a cable, a hand or a shock of the release is not",
    needs=("scene", "poses", "force"),
)
def force_without_contact(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the force begins while the tip is far from the walls by poses."""
    begin = motion.force_onset
    if motion.force is None or begin is None or motion.pair is None:
        return
    t = motion.smooth_times
    at = int(np.searchsorted(t, begin))
    if not 0 < at < len(t) or t[at] - t[at - 1] > _NEAR_TIME:
        return
    gap = float(min(motion.stiff_gap[at - 1 : at + 1]))
    if gap > max(_FAR, 6.0 * motion.pose_noise):
        yield Said(
            motion.force.topic,
            f"force begins while poses have the tip {1e3 * gap:.3g} mm from the walls: must be "
            "below 20 mm; check cables, and the clocks",
        )


@rule(
    "force_impulse",
    Grade.NOTED,
    compares="impulse of the force over the first contact, in the target's axes, with the change "
    "of the chaser's momentum",
    threshold=f"size < {_SMALL:g} or > {_LARGE:g} of it; or turned by > "
    f"{math.degrees(_TURNED):.0f} deg and 3 standard errors",
    reason="none of the 200 clean recordings of benchmarks/detection.py is beyond, though "
    "friction, sampling and the noise of poses turn it; the force is that on the cone, in N",
    needs=("scene", "poses", "force", "rate", "contact"),
)
def force_impulse_fits(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if axes, sign or unit of the force do not fit the chaser's motion."""
    found = force_impulse(motion)
    if found is None or motion.force is None:
        return
    turned = math.degrees(found.angle)
    text, cause = "", ""
    if not _SMALL <= found.ratio <= _LARGE:
        text = f"impulse {found.ratio:.3g} of the chaser's change of momentum: must be about 1"
        cause = "is it in kN, or is the cell not in the path of the force?"
        if found.ratio > _LARGE:
            cause = "it must be in N, not in counts or mN"
    elif abs(found.angle) > max(_TURNED, 3.0 * found.error):
        text = (
            f"impulse turned by {turned:+.0f} deg from the chaser's change of momentum: must be "
            f"below {math.degrees(_TURNED):.0f} deg"
        )
        cause = "check the axes of the cell and its frame_id"
        if abs(found.angle) > math.pi - _TURNED:
            cause = "the sign looks inverted: it must be the force on the cone"
    if text:
        yield Said(motion.force.topic, f"{text}; {cause}")
