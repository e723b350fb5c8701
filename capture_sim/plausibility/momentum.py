"""Balances of momentum over the first contact: by poses, by the force, and by the buffer's spring.

Between two instants around the contact, the chaser loses the momentum that the force has on the
tip, and that the axial spring hands on.  The damper's part is the difference of two strokes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from capture_sim.plausibility.motion import MeasuredMotion
from capture_sim.plausibility.signals import noise, slope

#: Windows before and after the begin of a contact between which momentum is balanced, s.
BEFORE, AFTER = 0.15, 0.5
#: Half of the window that a speed is measured over, s, and poses in it at least.
_HALF, _MIN_POSES = 0.1, 8
#: Change of the chaser's speed that shows a contact, m/s.
_MIN_CHANGE = 0.02
#: Least rate at which an impulse of touches is known, Hz.
_MIN_RATE = 300.0
#: Mean stroke over the contact that an encoder must show, m, or in standard deviations.
_MIN_STROKE, _DEVIATIONS = 1e-3, 6.0
#: The buffer is at rest until this before the first window, s.
_MARGIN = 0.1


class SpeedChange(NamedTuple):
    """Change of the chaser's speed along an axis between two instants, s."""

    begin: float
    end: float
    speed: float  # m/s


def change_of_speed(motion: MeasuredMotion, contact: float, axis: np.ndarray) -> SpeedChange | None:
    """Return the change of the chaser's speed over a contact, s; None if it is not known.

    ``axis``: heading (n,), rad, of the poses of the pair, whose median around the contact counts.
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
    if abs(change) < max(_MIN_CHANGE, 5.0 * math.hypot(*errors)):
        return None
    return SpeedChange(*ends, change)


def force_ratio(motion: MeasuredMotion) -> float | None:
    """Return the impulse of the force over the chaser's change of momentum; None if unknown."""
    turned = motion.cone_force
    if turned is None or motion.pair is None or motion.scene is None:
        return None
    t, force = turned
    if len(t) < 2 or 1.0 / max(float(np.median(np.diff(t))), 1e-9) < _MIN_RATE:
        return None
    change = _first_change(motion, motion.pair.target[:, 2])
    if change is None:
        return None
    quiet = (t >= change.begin - 4.0 * BEFORE) & (t < change.begin)
    impulse = _integral(t, force[:, 0], change, quiet)
    if impulse is None:
        return None
    return impulse / (motion.scene.chaser_total_mass * change.speed)


def spring_ratio(motion: MeasuredMotion) -> float | None:
    """Return the impulse of the axial spring over the chaser's change of momentum.

    None if it is not known, if the spring is not linear, or if it need not yield visibly.
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
    stroke = buffer.stroke[kept][first]
    change = _first_change(motion, pair.chaser[:, 2])
    if change is None:
        return None
    momentum = (scene.chaser.mass + scene.cylinder.mass) * change.speed
    expected = abs(momentum) / spring.k_A  # m s
    least = max(_MIN_STROKE, _DEVIATIONS * noise(stroke)) * (BEFORE + AFTER)
    if expected < least:
        return None
    impulse = _integral(t, stroke, change, t < change.begin - _MARGIN)
    return None if impulse is None else impulse * spring.k_A / momentum


def _first_change(motion: MeasuredMotion, axis: np.ndarray) -> SpeedChange | None:
    """Return the chaser's loss of speed over the first contact that any source shows."""
    begins = sorted(motion.contacts.values())
    begins = begins or ([] if motion.near_time is None else [motion.near_time])
    # a later one is no first contact: rolling resistance changes the speed as well
    near = [begin for begin in begins if begin <= begins[0] + BEFORE]
    changes = (change_of_speed(motion, begin, axis) for begin in near)
    return next((found for found in changes if found is not None and found.speed < 0.0), None)


def _integral(
    t: np.ndarray, values: np.ndarray, change: SpeedChange, quiet: np.ndarray
) -> float | None:
    """Return the integral of values (n,) over a change, less what they were before, ``quiet``."""
    during = (t >= change.begin) & (t <= change.end)
    if during.sum() < 20 or t[0] > change.begin or t[-1] < change.end or quiet.sum() < 20:
        return None
    values = values[during] - np.median(values[quiet])
    return float(0.5 * (values[1:] + values[:-1]) @ np.diff(t[during]))
