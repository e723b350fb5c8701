"""Balances of momentum over the first contact: by poses, by the force and by the buffer's spring.

Between an instant before the first contact and one after it, poses give the change of the chaser's
momentum.  It must equal the impulse of the measured force on the tip, and the impulse that the
axial spring transmits to the chaser.  The damper's impulse is neglected: it is proportional to the
difference between the strokes at the two instants.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from capture_sim.plausibility.motion import MeasuredMotion
from capture_sim.plausibility.signals import noise, slope

#: Momentum is balanced from BEFORE to AFTER, s, measured from the begin of the contact.
BEFORE, AFTER = 0.15, 0.5
#: Half of the time over which a speed is measured, s, and least number of poses in that time.
_HALF, _MIN_POSES = 0.1, 8
#: Least change of the chaser's speed that shows a contact, m/s.
_MIN_CHANGE = 0.02
#: Least rate of a force from which the impulse of a whole contact can be computed, Hz: a contact is
#: hundreds of touches, or lasts.
_MIN_RATE = 50.0
#: Least mean stroke over the contact that an encoder can show, in m and in standard deviations.
_MIN_STROKE, _DEVIATIONS = 1e-3, 6.0
#: The stroke at rest is taken from times that end this long before the first instant, s.
_MARGIN = 0.1


class SpeedChange(NamedTuple):
    """Change of the chaser's speed along an axis between two instants."""

    begin: float  # s
    end: float  # s
    speed: float  # speed at the end less that at the begin, m/s
    error: float  # m/s, standard error of it


def change_of_speed(
    motion: MeasuredMotion, contact: float, axis: np.ndarray, least: float = _MIN_CHANGE
) -> SpeedChange | None:
    """Return the change of the chaser's speed over a contact; None if it is not known.

    ``contact`` is the time of the contact's begin, s.  ``axis`` (n,), rad, is the heading of one
    vehicle at each pose of ``motion.pair``; the speed is that along the median heading around the
    contact.  The change is not known if there are too few poses around one of the two instants, or
    if it is below ``least``, m/s, or, unless that is 0, five of its standard errors.
    """
    pair = motion.pair
    if pair is None:
        return None
    near = np.abs(pair.t - contact) < 2.0 * _HALF
    if not near.any():
        return None
    angle = float(np.median(axis[near]))
    along = pair.chaser[:, 0] * math.cos(angle) + pair.chaser[:, 1] * math.sin(angle)
    ends, speeds, errors = (contact - BEFORE, contact + AFTER), [], []
    for end in ends:
        near = np.abs(pair.t - end) <= _HALF
        if near.sum() < _MIN_POSES or float(np.diff(pair.t[near]).max()) > _HALF:
            return None
        speed, error = slope(pair.t[near], along[near])
        speeds.append(speed)
        errors.append(error)
    change = speeds[1] - speeds[0]
    if abs(change) < max(least, 5.0 * math.hypot(*errors) if least else 0.0):
        return None
    return SpeedChange(*ends, change, math.hypot(*errors))


def has_change(motion: MeasuredMotion) -> bool:
    """Return True if poses show a first contact that changes the chaser's speed."""
    return motion.pair is not None and first_change(motion, motion.pair.chaser[:, 2]) is not None


class Impulse(NamedTuple):
    """Impulse of the measured force over the first contact, beside the change of momentum."""

    ratio: float  # size of the impulse over that of the change of momentum
    angle: float  # from the change of momentum to the impulse, rad, -pi to pi
    error: float  # rad, standard error of the direction of the change of momentum


def force_impulse(motion: MeasuredMotion) -> Impulse | None:
    """Return the impulse of the force on the tip; a ratio of 1 and an angle of 0 if all fits.

    None if the force has fewer than 50 samples per second, if there is no scene, or if poses or
    force do not cover the contact and a time before it.
    """
    turned = motion.cone_force
    if turned is None or motion.pair is None or motion.scene is None or lacks_rate(motion):
        return None
    t, force = turned
    axis = motion.pair.target[:, 2]
    along = first_change(motion, axis)
    if along is None:
        return None
    across = change_of_speed(motion, along.begin + BEFORE, axis + 0.5 * math.pi, 0.0)
    quiet = (t >= along.begin - 4.0 * BEFORE) & (t < along.begin)
    parts = [x for column in force.T if (x := _integral(t, column, along, quiet)) is not None]
    if across is None or len(parts) < 2:
        return None
    momentum = motion.scene.chaser_total_mass * np.array([along.speed, across.speed])
    size = math.hypot(*momentum)
    angle = math.atan2(parts[1], parts[0]) - math.atan2(momentum[1], momentum[0])
    error = math.hypot(along.error, across.error) / math.hypot(along.speed, across.speed)
    return Impulse(math.hypot(*parts) / size, math.remainder(angle, math.tau), error)


def lacks_rate(motion: MeasuredMotion) -> str:
    """Return why the force is sampled too slowly for the impulse of a contact; '' if it is not."""
    force = motion.force
    if force is None or force.count < 2:
        return "no force in known axes"
    rate = 1.0 / max(float(np.median(np.diff(np.sort(force.t)))), 1e-9)
    return f"force at {rate:.3g} Hz: must be {_MIN_RATE:g} Hz or more" if rate < _MIN_RATE else ""


def spring_ratio(motion: MeasuredMotion, *, exchanged: bool = False) -> float | None:
    """Return the axial spring's impulse divided by the chaser's change of momentum.

    With ``exchanged``, the encoder of the torsion is taken for that of the stroke.

    Both are along the chaser's x axis, over the first contact.  The impulse is ``k_A`` times the
    integral of the stroke; the mass is that of chaser and cylinder.  The ratio is about 1 if
    stroke, poses and ``k_A`` fit.

    None if there is no scene, if poses or encoder do not cover the contact and a time before it, or
    if the spring may yield less than the encoder can show.  None also for a buffer with a nonlinear
    spring, a seat, friction or stops, because its force is then not ``k_A`` times the stroke.
    """
    scene, pair, buffer = motion.scene, motion.pair, motion.buffer
    if scene is None or pair is None or buffer is None:
        return None
    spring = scene.buffer
    if spring.force_table or spring.seat_force or spring.friction or scene.stops is not None:
        return None
    if spring.k_A <= 0.0 or spring.k_A3 > 0.0:
        return None
    kept = buffer.is_measured
    t, first = np.unique(buffer.t[kept], return_index=True)
    stroke = (buffer.torsion if exchanged else buffer.stroke)[kept][first]
    change = first_change(motion, pair.chaser[:, 2])
    if change is None:
        return None
    momentum = (scene.chaser.mass + scene.cylinder.mass) * change.speed
    expected = abs(momentum) / spring.k_A  # m s
    least = max(_MIN_STROKE, _DEVIATIONS * noise(stroke)) * (BEFORE + AFTER)
    if expected < least:
        return None
    impulse = _integral(t, stroke, change, t < change.begin - _MARGIN)
    return None if impulse is None else impulse * spring.k_A / momentum


def first_change(motion: MeasuredMotion, axis: np.ndarray) -> SpeedChange | None:
    """Return the change of the chaser's speed over the first contact; None if no loss is known.

    The contact begins where the first of poses, buffer and force shows it, or, if that shows no
    loss of speed, where the next one does within ``BEFORE``.  If none of them shows a contact, it
    begins where the tip first comes near a wall by poses.
    """
    begins = sorted(motion.contacts.values())
    begins = begins or ([] if motion.near_time is None else [motion.near_time])
    # a later one is no first contact: rolling resistance changes the speed as well
    near = [begin for begin in begins if begin <= begins[0] + BEFORE]
    changes = (change_of_speed(motion, begin, axis) for begin in near)
    return next((found for found in changes if found is not None and found.speed < 0.0), None)


def _integral(
    t: np.ndarray, values: np.ndarray, change: SpeedChange, quiet: np.ndarray
) -> float | None:
    """Return the integral of ``values`` (n,), less their level at rest, over ``change``.

    ``t`` (n,) are the times of the values, s.  The level at rest is the median of the values that
    ``quiet`` (n,) bool marks.  None if the values do not cover the change, or if fewer than 20 are
    in it or at rest.
    """
    during = (t >= change.begin) & (t <= change.end)
    if during.sum() < 20 or t[0] > change.begin or t[-1] < change.end or quiet.sum() < 20:
        return None
    values = values[during] - np.median(values[quiet])
    return float(0.5 * (values[1:] + values[:-1]) @ np.diff(t[during]))
