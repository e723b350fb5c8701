"""Rules of the buffer: do the vehicles' poses and the buffer's encoders agree with each other?"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from capture_sim.plausibility.momentum import first_change, spring_ratio
from capture_sim.plausibility.motion import MIN_MESSAGES, N_SMOOTH, MeasuredMotion
from capture_sim.plausibility.rules import Grade, Said, rule
from capture_sim.plausibility.signals import AWAY, smooth, zero_text

#: Least depth of the tip in a wall that contradicts the buffer, m.  Errors of the base frames and
#: noise make up to about 2 mm.
MIN_DEPTH = 4e-3
#: The depth must also exceed this number of standard deviations of a single pose.  The depth is a
#: running median of nine poses, and thus less noisy.
_DEVIATIONS = 2.5
#: Bounds of :func:`spring_ratio`, the spring's impulse over the chaser's change of momentum, which
#: is about 1.  They are wide, because k_A may be wrong by a third.
SPRING_LOW, SPRING_HIGH = 0.15, 5.0
#: ... with the encoder of the torsion: right ones have at most 0.15 in size there.
EXCHANGED_LOW, EXCHANGED_HIGH = 0.4, 2.0
#: Bounds of the same ratio beyond which the encoder's scale is doubted.
_SCALE_LOW, _SCALE_HIGH = 0.5, 1.4
#: ... and of the stroke to what poses show of it while the latch holds the tip.
_HELD_LOW, _HELD_HIGH = 0.75, 1.33
#: A ratio from here on is one of units, for which there is another rule.
_UNITS = 30.0
#: The latch holds a tip that is nearer to BE than this, m, by poses alone, to the end of the
#: recording; from so long after, s, for so long, s, with a stroke of this standard deviation, m.
_NEAR_BE, _SETTLED, _HELD, _MOVES = 0.02, 0.4, 0.5, 3e-4
#: A stroke (m) and a torsion (rad) that vary by less than this count as not moving.
_STANDS = (3e-4, 1e-3)
#: Lags between poses and buffer that are tried, s.
_LAGS = np.arange(-0.5, 0.501, 0.01)


class Contradiction(NamedTuple):
    """A contradiction between the vehicles' poses and the buffer's encoders.

    Either the poses and the encoders together place the tip inside of a wall, or the encoder's
    stroke does not fit the chaser's change of momentum.

    ``kind`` is the likely cause: "stuck" if an encoder does not move, "inverted" if it has the
    wrong sign, "exchanged" if each has the name of the other, "lag" if the times are shifted
    against those of the poses, or "other".
    """

    kind: str
    text: str  # value and expectation
    detail: str  # names of the encoders; the size of the shift for "lag"; may be empty for "other"


def find_contradiction(motion: MeasuredMotion) -> Contradiction | None:
    """Return the contradiction between poses and encoders; None if there is none.

    None also without a scene, without poses of both vehicles, or without states of the buffer.  The
    chaser's change of momentum is compared first, the position of the tip only if that fits or is
    not known.
    """
    if motion.pair is None or motion.scene is None or motion.buffer is None:
        return None
    at = motion.deflections_at(motion.pair.t)
    if at is None:
        return None
    ratio = spring_ratio(motion)
    if ratio is not None and not SPRING_LOW <= ratio <= SPRING_HIGH:
        other = spring_ratio(motion, exchanged=True)
        is_inverted = ratio < -SPRING_LOW
        kind = "inverted" if is_inverted else "stuck" if ratio < SPRING_LOW else "other"
        if other is not None and EXCHANGED_LOW <= other <= EXCHANGED_HIGH:
            kind = "exchanged"
        text = (
            f"the spring's impulse by the stroke is {ratio:.3g} of the chaser's change of "
            f"momentum: must be about 1"
        )
        return Contradiction(kind, text, "stroke")
    stroke, torsion = at
    limit = max(MIN_DEPTH, _DEVIATIONS * motion.pose_noise)
    deepest = _deepest(motion, stroke, torsion)
    if deepest <= limit:
        return None
    text = (
        f"poses have the tip {1e3 * deepest:.3g} mm inside of a wall: must be below "
        f"{1e3 * limit:.3g} mm"
    )
    near = motion.stiff_depth > 0.0
    t = motion.smooth_times[near]
    during = (motion.pair.t >= t[0]) & (motion.pair.t <= t[-1]) if near.any() else slice(None)
    moves = [float(np.nanmax(x[during]) - np.nanmin(x[during])) for x in (stroke, torsion)]
    if moves[0] < _STANDS[0] and moves[1] < _STANDS[1]:
        return Contradiction("stuck", text, "stroke and torsion")
    for names, signs in (
        ("stroke", (-1.0, 1.0)),
        ("torsion", (1.0, -1.0)),
        ("stroke and torsion", (-1.0, -1.0)),
    ):
        if _deepest(motion, signs[0] * stroke, signs[1] * torsion) < 0.6 * limit:
            return Contradiction("inverted", text, names)
    if moves[0] < _STANDS[0]:
        return Contradiction("stuck", text, "stroke")
    depths = []
    for lag in _LAGS:
        later = motion.deflections_at(motion.pair.t + lag)
        depths.append(_deepest(motion, *later) if later is not None else np.inf)
    best = int(np.argmin(depths))
    if depths[best] < 0.6 * limit:
        return Contradiction("lag", text, f"{abs(_LAGS[best]):.2f} s")
    return Contradiction("other", text, "")


def _deepest(motion: MeasuredMotion, stroke: np.ndarray, torsion: np.ndarray) -> float:
    """Return the largest running median of the tip's depth in a wall, m; 0 if it is in no wall.

    ``stroke`` (m) and ``torsion`` (rad), (n,) each, are those at the times of ``motion.pair``; NaN
    where the encoders have a gap.  These times are left out.
    """
    depth = motion.depth(stroke, torsion)
    known = depth[np.isfinite(stroke)]
    smoothed = smooth(known, N_SMOOTH)
    smoothed = smoothed[np.isfinite(smoothed)]
    return float(smoothed.max(initial=0.0))


@rule(
    "buffer_zero",
    Grade.NOTED,
    compares="median of the last 200 states of the buffer at which the tip is > 10 mm ahead of the "
    "cone's mouth, before the closest approach, with 0",
    threshold="> 0.05 mm at the tip and > 5 standard errors",
    reason="a contact begins at `max_contact_gap`, 0.2 mm; the zero is subtracted wherever the "
    "buffer is evaluated",
    needs=("scene", "poses", "buffer"),
)
def buffer_zero(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the encoders of the buffer are not at 0 at rest, or if it never rests."""
    assert motion.buffer is not None
    if text := zero_text(motion.zero):
        yield Said(motion.buffer.topic, text)
    elif not np.isfinite(motion.zero_error).all() and motion.stiff_gap[:1].min(initial=1.0) < AWAY:
        text = "no state at rest before the contact: the zero is not known and counts as 0"
        yield Said(motion.buffer.topic, text)


#: Likely cause of each kind of a contradiction, and what to do.
_CAUSES = {
    "stuck": "{} does not follow the contact: check the encoder and its unit",
    "inverted": "{} looks inverted: the stroke must be negative when compressed, and the torsion "
    "positive about z",
    "exchanged": "stroke and torsion look exchanged: check the names of the joints",
    "lag": "the buffer fits the poses {} apart: check the clocks",
    "other": "check base frames, lengths of the scene, unit and zero of the encoders",
}


@rule(
    "buffer_against_poses",
    Grade.REFUSED,
    compares="impulse of the axial spring over the first contact with the chaser's change of "
    "momentum; position of the tip by poses and buffer with the walls",
    threshold=f"ratio out of {SPRING_LOW:g} to {SPRING_HIGH:g}, or, for exchanged joints, that of "
    f"the torsion in {EXCHANGED_LOW:g} to {EXCHANGED_HIGH:g}; or inside of a wall by > 4 mm and > "
    "2.5 standard deviations",
    reason="the ratio is 0.6 to 1 where k_A is known to a third; base frames and noise make a "
    "depth of 2 mm. Exchanged joints are not found where the first contact hardly changes the "
    "speed",
    needs=("scene", "poses", "buffer"),
)
def buffer_against_poses(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if poses and encoders contradict each other, with the likely cause."""
    found = find_contradiction(motion)
    if found is not None and motion.buffer is not None:
        cause = _CAUSES[found.kind].format(found.detail)
        yield Said(motion.buffer.topic, f"{found.text}; {cause}")


def _held_ratios(motion: MeasuredMotion) -> list[tuple[float, float]]:
    """Return the ratio of the stroke to what poses show of it, and its standard error, three times.

    A tip that the latch holds stays in its place, so that all motion of the hinge is stroke.  The
    ratios are of the time in which it is held, and of both halves of it, because it may be held in
    the second only.  Empty without a latch, if it is not held for :data:`_HELD` s, or if the stroke
    hardly moves.
    """
    found = None if motion.pair is None else motion.deflections_at(motion.pair.t)
    if found is None or motion.pair is None or motion.scene is None or motion.scene.latch is None:
        return []
    ahead, beside = motion.tip(np.zeros(len(motion.pair.t)), found[1])
    stroke, t = found[0], motion.pair.t
    is_known = np.isfinite(stroke) & np.isfinite(ahead)
    away = np.flatnonzero(is_known & (np.hypot(ahead, beside) > _NEAR_BE))
    held = np.flatnonzero(is_known & (t > (t[away[-1]] if away.size else t[0]) + _SETTLED))
    if len(held) < 2 * MIN_MESSAGES or np.ptp(t[held]) < _HELD:
        return []
    ratios = []
    for part in (held, *np.array_split(held, 2)):
        shown, moved = ahead[part] - ahead[part].mean(), stroke[part] - stroke[part].mean()
        if np.std(moved) < _MOVES:
            return []
        # fitted to the stroke, because poses are noisier
        slope = float(shown @ moved) / float(moved @ moved)
        left = shown - slope * moved
        error = math.sqrt(float(left @ left) / (len(left) - 2) / float(moved @ moved))
        if slope < 3.0 * error:
            return []
        ratios.append((1.0 / slope, error / slope**2))
    return ratios


@rule(
    "buffer_scale",
    Grade.NOTED,
    compares="stroke with its change by poses while the latch holds the tip; impulse of the axial "
    "spring over the first contact with the chaser's change of momentum",
    threshold=f"ratio out of {_HELD_LOW:g} to {_HELD_HIGH:g}, or of {_SCALE_LOW:g} to "
    f"{_SCALE_HIGH:g}, by > 3 standard errors",
    reason="none of the 200 clean recordings of benchmarks/detection.py is beyond; in the impulse "
    "a scale of the encoder and an error of k_A act alike",
    needs=("scene", "poses", "buffer"),
)
def buffer_scale(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the stroke's scale, or k_A, is off by about a factor of 2."""
    held, pair = _held_ratios(motion), motion.pair
    if motion.buffer is None or pair is None:
        return
    if held:
        (whole, error), *halves = held
        values = [value for value, _ in halves]
        is_small = max(whole + 3.0 * error, *values) < _HELD_LOW
        is_large = min(whole - 3.0 * error, *values) > _HELD_HIGH
        if is_small or (is_large and whole < _UNITS):
            yield Said(
                motion.buffer.topic,
                f"the stroke is {whole:.2g} of what poses show while the latch holds the tip: "
                "must be 1; check the encoder's scale; strokes and distances are wrong by as much",
            )
        return
    ratio = spring_ratio(motion)
    if ratio is None:
        return
    change = first_change(motion, pair.chaser[:, 2])
    if change is None or not SPRING_LOW <= ratio <= SPRING_HIGH:
        return
    unsure = 1.0 + 3.0 * change.error / abs(change.speed)
    if ratio * unsure < _SCALE_LOW or ratio > _SCALE_HIGH * unsure:
        yield Said(
            motion.buffer.topic,
            f"the spring's impulse by the stroke is {ratio:.2g} of the chaser's change of "
            "momentum: must be about 0.8; check the encoder's scale and buffer.k_A",
        )
