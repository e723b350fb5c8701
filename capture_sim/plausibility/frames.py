"""Rules of frames: are poses those of the base frames, in one frame whose z axis points up?"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from capture_sim.plausibility.measured import Poses
from capture_sim.plausibility.motion import MIN_MESSAGES, MeasuredMotion
from capture_sim.plausibility.rules import Grade, Said, rule
from capture_sim.plausibility.signals import noise, smooth, span

#: A median tilt beyond this is refused, rad.
MAX_TILT = 0.12
#: Motion along z is refused above the first number, m, and above this share of the motion in the
#: plane.
_OUT_OF_PLANE, _SLOPE = 6e-3, 0.03
#: Norms of quaternions may differ from 1 by this.
_NORM_ERROR = 0.02
#: Vehicles overlap if they are nearer than this number times their distance at contact.
_OVERLAP = 0.5
#: Largest angle in the approach between a vehicle's x axis and the line from chaser to target, rad.
_MAX_BEARING = 1.3
#: Least travel, m, from which the direction of a vehicle's motion is known.
_MOVED = 0.03


@rule(
    "quaternion_norm",
    Grade.NOTED,
    compares="norm of quaternions with 1",
    threshold=f"median differs by > {_NORM_ERROR:g}",
    reason="rounding makes 1e-7; a norm of another size is no orientation in this convention",
)
def quaternion_norm(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each vehicle whose quaternions do not have the norm 1."""
    for _, poses in motion.measured.vehicles:
        norm = poses.norm[poses.is_measured]
        if len(norm) and abs(float(np.median(norm)) - 1.0) > _NORM_ERROR:
            yield Said(
                poses.topic,
                f"norm of the quaternions {np.median(norm):.3g}: must be 1; check the driver's "
                "convention",
            )


@rule(
    "tilted",
    Grade.REFUSED,
    compares="angle between a vehicle's z axis and the world's",
    threshold=f"median > {MAX_TILT:g} rad (7 deg)",
    reason="a tilt of 0.12 rad shortens 0.45 m by 3 mm, most of the capture zone; roll and pitch "
    "of a floor and of a marker plate are some mrad",
)
def tilted(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each vehicle that is tilted out of the plane."""
    for name, poses in motion.measured.vehicles:
        tilt = poses.tilt
        if len(tilt) < MIN_MESSAGES or float(np.median(tilt)) <= MAX_TILT:
            continue
        turned = math.degrees(float(np.median(tilt)))
        yield Said(
            poses.topic,
            f"{name} tilted out of the plane by {turned:.3g} deg: must be below 7 deg; "
            f"{_tilt_cause(poses)}",
        )


def _tilt_cause(poses: Poses) -> str:
    """Return the likely cause of a tilt and its remedy, as a text for the user.

    Quaternions with w first and a y axis that points up are recognised.
    """
    q = poses.quaternion[poses.is_measured] / poses.norm[poses.is_measured, None]
    w, x, y, _ = q.T  # if w comes first
    if float(np.median(np.hypot(x, y))) < 0.5 * MAX_TILT and abs(float(np.median(w))) > 0.5:
        return "the quaternion looks like w first: it must be x, y, z, w"
    x, y, z, _ = q.T
    if float(np.median(np.hypot(x, z))) < 0.5 * MAX_TILT:
        return "it turns about y, as with y up: have the driver send z up"
    return "check the base frame of the rigid body, and that z is up"


@rule(
    "out_of_plane",
    Grade.REFUSED,
    compares="motion of a vehicle along z",
    threshold="> 6 mm, > 6 standard deviations and > 3 % of the motion in the plane",
    reason="a world that is not levelled by 1 deg moves z by 1.7 % of the travel",
)
def out_of_plane(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each vehicle that moves along z, out of the plane."""
    for name, poses in motion.measured.vehicles:
        kept = poses.is_measured
        if kept.sum() < 3 * MIN_MESSAGES:
            continue
        x, y, z = (smooth(column, 9) for column in poses.position[kept].T)
        moved = span(z)
        plane = math.hypot(span(x), span(y))
        limit = max(_OUT_OF_PLANE, 6.0 * noise(poses.position[kept, 2]), _SLOPE * plane)
        if moved <= limit:
            continue
        stands = span(y) < 0.25 * moved
        look = (
            "y stands, as with y up: have the driver send z up"
            if stands
            else "check that the world's z axis points up and the floor is level"
        )
        yield Said(
            poses.topic,
            f"{name} moves by {1e3 * moved:.3g} mm along z: must be below {1e3 * limit:.3g} mm; "
            f"{look}",
        )


@rule(
    "heights_differ",
    Grade.REFUSED,
    compares="height of the chaser's base frame with that of the target's",
    threshold="differ by more than the half-width of the cone's mouth",
    reason="with y up this is the lateral offset, at which the tip passes beside the cone",
    needs=("scene", "poses"),
)
def heights_differ(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the base frames differ in height by more than the cone's half-width.

    If the data has y pointing up, this difference is in fact a lateral offset.
    """
    if motion.pair is None or motion.scene is None:
        return
    cone = motion.scene.cone
    mouth = cone.R_c + cone.L_c * math.sin(cone.half_angle)
    height = float(np.median(motion.pair.z_target - motion.pair.z_chaser))
    if abs(height) > mouth:
        yield Said(
            motion.pair_topic,
            f"base frames differ in height by {1e3 * abs(height):.3g} mm: must be below "
            f"{1e3 * mouth:.3g} mm; with y up this is a lateral offset: have the driver send z up, "
            "or set both base frames at the height of the tip",
        )


@rule(
    "frames_differ",
    Grade.REFUSED,
    compares="header.frame_id of the chaser's poses with that of the target's",
    threshold="not equal",
    reason="poses in two frames have no distance",
)
def frames_differ(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the poses of the two vehicles have no ``frame_id`` in common.

    Leading slashes do not count.  A vehicle without a ``frame_id`` is not compared.
    """
    chaser, target = motion.chaser, motion.target
    if chaser is None or target is None:
        return
    of_c, of_t = _named(chaser), _named(target)
    if of_c and of_t and not of_c & of_t:
        yield Said(
            motion.pair_topic,
            f"frame_id {_listed(of_c)} of the chaser, {_listed(of_t)} of the target: must be one "
            "frame; transform one of them, or waive the rule if they are the same",
        )


@rule(
    "frame_changes",
    Grade.REFUSED,
    compares="header.frame_id of all messages of a topic",
    threshold="more than one",
    reason="two publishers, or a driver that was set up anew",
)
def frame_changes(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding for each topic whose messages have more than one ``frame_id``.

    Leading slashes do not count, and neither do messages without a ``frame_id``.
    """
    for channel in motion.measured.channels:
        if len(_names(channel.frame_ids)) > 1:
            yield Said(
                channel.topic,
                f"frame_id {_listed(_names(channel.frame_ids))}: must be one; end one of the "
                "publishers",
            )


def _named(poses: Poses) -> set[str]:
    return _names(poses.frame_ids)


def _names(frame_ids: tuple[str, ...]) -> set[str]:
    return {name.lstrip("/") for name in frame_ids} - {""}


def _listed(names: set[str]) -> str:
    return " and ".join(repr(name) for name in sorted(names))


@rule(
    "bodies_overlap",
    Grade.REFUSED,
    compares="distance between the vehicles with that at contact by the scene",
    threshold="nine tenths of the poses are nearer than a half",
    reason="the tip would be behind the cone's throat by 0.2 m; a chaser that passes by comes so "
    "near only for a while",
    needs=("scene", "poses"),
)
def bodies_overlap(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the vehicles are nearer to each other than their bodies allow.

    If they are almost at the same position, both topics probably have the pose of one body.
    """
    if motion.pair is None:
        return
    distance = float(np.percentile(motion.distance, 90.0))
    if distance >= _OVERLAP * motion.contact_distance:
        return
    cause = (
        "both topics have the pose of one body; check the remapping"
        if distance < 0.02
        else "check the base frames and the units"
    )
    yield Said(
        motion.pair_topic,
        f"distance between the vehicles {distance:.3g} m: must be "
        f"{motion.contact_distance:.3g} m at contact; {cause}",
    )


@rule(
    "not_facing",
    Grade.REFUSED,
    compares="in the approach: direction to the other vehicle with the base frame's x axis",
    threshold=f"median > {_MAX_BEARING:g} rad (74 deg)",
    reason="the chaser launches along its x axis, and the cone opens towards -x of the target's: "
    "bodies swapped or frames turned by 90 deg or more are beyond, every launch of a scene is not",
    needs=("poses",),
)
def not_facing(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if chaser or target does not face along the approach.

    The two bodies are then swapped, or a base frame is turned.
    """
    pair = motion.pair
    if pair is None:
        return
    if float(np.median(motion.distance)) < 0.1:
        return  # bodies_overlap
    kept = motion.approach
    towards = np.arctan2(*(pair.target[kept, :2] - pair.chaser[kept, :2]).T[::-1])
    of_c = _median_angle(towards - pair.chaser[kept, 2])
    of_t = _median_angle(towards - pair.target[kept, 2])
    if abs(of_c) <= _MAX_BEARING and abs(of_t) <= _MAX_BEARING:
        return
    degrees = [math.degrees(angle) for angle in (of_c, of_t)]
    if abs(of_c) > math.pi - _MAX_BEARING and abs(of_t) > math.pi - _MAX_BEARING:
        travels = [math.hypot(span(p[:, 0]), span(p[:, 1])) for p in (pair.chaser, pair.target)]
        cause = "the bodies look swapped; check the remapping"
        if travels[0] > 2.0 * travels[1] + _MOVED:
            cause = "both base frames look turned by 180 deg; define x forward along the approach"
        name, angle = "target is behind the chaser", degrees[0]
    elif abs(of_c) > _MAX_BEARING:
        cause = "the chaser's base frame must have x forward along the approach"
        name, angle = "target is not ahead of the chaser", degrees[0]
    else:
        cause = "the cone must open towards -x of the target's base frame"
        name, angle = "chaser is not before the cone", degrees[1]
    yield Said(
        motion.pair_topic,
        f"{name}: seen {abs(angle):.3g} deg off the x axis, must be below 74 deg; {cause}",
    )


@rule(
    "moves_backwards",
    Grade.REFUSED,
    compares="motion of the chaser in the approach with its heading",
    threshold="moved by > 30 mm, more than 90 deg off its x axis, towards the target",
    reason="the chaser launches along its x axis",
    needs=("poses",),
)
def moves_backwards(motion: MeasuredMotion) -> Iterator[Said]:
    """Yield a finding if the chaser approaches the target backwards, against its own heading."""
    pair = motion.pair
    if pair is None:
        return
    kept = np.flatnonzero(motion.approach)
    if len(kept) < 2 * MIN_MESSAGES:
        return
    begin, end = kept[: len(kept) // 5 + 1], kept[-(len(kept) // 5 + 1) :]
    moved = np.median(pair.chaser[end, :2], axis=0) - np.median(pair.chaser[begin, :2], axis=0)
    nearer = float(np.median(motion.distance[begin]) - np.median(motion.distance[end]))
    travel = float(np.hypot(*moved))
    if travel < _MOVED or nearer < 0.5 * travel:
        return
    heading = float(np.median(pair.chaser[kept, 2]))
    forward = float(moved @ [math.cos(heading), math.sin(heading)])
    if forward < 0.0:
        yield Said(
            motion.measured.chaser.topic if motion.measured.chaser else motion.pair_topic,
            f"chaser moves backwards along its heading by {1e3 * -forward:.3g} mm: must move "
            "forward; define x of its base frame along the approach",
        )


def _median_angle(angles: np.ndarray) -> float:
    """Return the median of angles (n,), rad, in -pi to pi.

    Each angle is taken within half a turn of the mean direction, so that the median does not depend
    on where the angles jump by a turn.
    """
    mean = math.atan2(float(np.sin(angles).mean()), float(np.cos(angles).mean()))
    off = np.angle(np.exp(1j * (angles - mean)))
    return math.remainder(mean + float(np.median(off)), math.tau)
