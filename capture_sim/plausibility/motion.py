"""Motion of the vehicles and of the tip from measurements, computed once for all rules.

All arrays are at the stamps of the chaser's poses, and are computed at their first use.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from capture_sim.plausibility.axes import FORCE_FRAMES, frame_of
from capture_sim.plausibility.measured import Deflections, Forces, Measured, Poses
from capture_sim.plausibility.signals import baseline, noise, onset, smooth
from capture_sim.scene.parts import Scene

#: Between poses that are further apart nothing is interpolated, s.
MAX_GAP = 0.25
#: Poses whose running median is compared with the walls.
N_SMOOTH = 9
#: Messages of a source that are needed to know its noise.
MIN_MESSAGES = 8
#: Poses that are closer than this, s, show every contact.
_TRACKED = 0.05
#: Least force, N, and share of the largest, that begin a contact.
_MIN_FORCE, _FORCE_SHARE = 2.0, 0.05
#: A limit above this may hide the begin of a contact, N.
_CLEAR = 3.0
#: Least deflection of the buffer that begins a contact, m.
MIN_DEFLECTION = 3e-4
#: A tip this close to a wall may touch it, m: base frames are no better.
_NEAR = 3e-3
#: ... and one this far from the walls does not, m.
_AWAY = 1e-2


class PosePair(NamedTuple):
    """Poses of both vehicles at common times."""

    t: np.ndarray  # (n,), s
    chaser: np.ndarray  # (n, 3): x, y (m), heading (rad)
    target: np.ndarray  # (n, 3)
    z_chaser: np.ndarray  # (n,), m
    z_target: np.ndarray  # (n,), m


class MeasuredMotion:
    """Measurements of one bench, and its scene (None if it is not known)."""

    def __init__(self, measured: Measured, scene: Scene | None) -> None:
        self.measured, self.scene = measured, scene
        self._made: dict[str, Any] = {}
        self._force_limit = 0.0  # N, that a force must pass to begin a contact

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """Return the result of ``make``, which is called once for each name."""
        if name not in self._made:
            self._made[name] = make()
        return self._made[name]

    @property
    def chaser(self) -> Poses | None:
        """Poses of the chaser; None without any."""
        return self.measured.chaser

    @property
    def target(self) -> Poses | None:
        """Poses of the target; None if none were measured."""
        return self.measured.target

    @cached_property
    def buffer(self) -> Deflections | None:
        """The buffer, if enough of its messages hold a measurement."""
        buffer = self.measured.buffer
        return buffer if buffer is not None and buffer.is_measured.sum() >= MIN_MESSAGES else None

    @cached_property
    def force(self) -> Forces | None:
        """The load cell, if its axes are known and enough of its messages hold a measurement."""
        force = self.measured.force
        if force is None or frame_of(force.frame_ids) is None:
            return None
        return force if force.is_measured.sum() >= MIN_MESSAGES else None

    @cached_property
    def pair(self) -> PosePair | None:
        """Poses of both vehicles at the chaser's stamps; None without poses of both."""
        chaser, target = self.chaser, self.target
        if chaser is None or target is None:
            return None
        of_c, of_t = chaser.is_measured, target.is_measured
        if of_c.sum() < MIN_MESSAGES or of_t.sum() < MIN_MESSAGES:
            return None
        t, first = np.unique(chaser.t[of_c], return_index=True)
        u, first_u = np.unique(target.t[of_t], return_index=True)
        inside = _is_covered(t, u)
        if inside.sum() < MIN_MESSAGES:
            return None
        values = np.column_stack([target.planar, target.position[of_t, 2]])[first_u]
        at = np.column_stack([np.interp(t[inside], u, column) for column in values.T])
        return PosePair(
            t[inside],
            chaser.planar[first][inside],
            at[:, :3],
            chaser.position[of_c, 2][first][inside],
            at[:, 3],
        )

    @property
    def pair_topic(self) -> str:
        """Both topics of poses, as a text."""
        names = [poses.topic for _, poses in self.measured.vehicles]
        return " and ".join(dict.fromkeys(names))

    @cached_property
    def distance(self) -> np.ndarray:
        """Distance between the base frames in the plane, (n,), m; empty without both."""
        if self.pair is None:
            return np.zeros(0)
        x, y = (self.pair.target[:, :2] - self.pair.chaser[:, :2]).T
        return np.asarray(np.hypot(x, y))

    @cached_property
    def contact_distance(self) -> float:
        """Distance between the base frames when the tip is at BE and all is straight, m."""
        assert self.scene is not None
        return self.scene.buffer.hinge_offset + self.scene.rest_length + self.scene.cone.L_T

    @cached_property
    def approach(self) -> np.ndarray:
        """True for each pose of :attr:`pair` in the approach, (n,) bool: before the closest one."""
        found = np.zeros(len(self.distance), dtype=bool)
        if len(self.distance):
            nearest = self.distance <= np.percentile(self.distance, 2.0)
            found[: max(int(np.argmax(nearest)), MIN_MESSAGES)] = True
        return found

    def deflections_at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return stroke (m) and torsion (rad) at times (n,), s; NaN in gaps; None without any."""
        buffer = self.buffer
        if buffer is None:
            return None
        kept = buffer.is_measured
        u, first = np.unique(buffer.t[kept], return_index=True)
        inside = _is_covered(t, u)
        stroke, torsion = (
            np.where(inside, np.interp(t, u, x[kept][first]), np.nan)
            for x in (buffer.stroke, buffer.torsion)
        )
        return stroke, torsion

    def depth(self, stroke: np.ndarray, torsion: np.ndarray) -> np.ndarray:
        """Return how deep the tip would be inside of a wall, (n,), m; negative before the wall.

        ``stroke`` (m) and ``torsion`` (rad), (n,) each, are those of the buffer at the times of
        :attr:`pair`.  A tip that has not been between the walls before, e.g. as it passes the cone
        outside of it, has minus infinity.
        """
        assert self.pair is not None
        assert self.scene is not None
        scene = self.scene
        ahead, beside = self._tip(stroke, torsion)
        R_c, L_c, cos_b, sin_b = scene.cone.wall
        radius = scene.probe.tip_radius
        deepest = np.full(len(ahead), -np.inf)
        for side in (1.0, -1.0):
            along = ahead * cos_b + (side * beside - R_c) * sin_b
            across = ahead * sin_b - (side * beside - R_c) * cos_b
            is_at_wall = (along >= 0.0) & (along <= L_c)
            was_inside = np.logical_or.accumulate(is_at_wall & (across > radius))
            depth = np.where(is_at_wall & was_inside, radius - across, -np.inf)
            deepest = np.maximum(deepest, depth)
        return deepest

    def _tip(self, stroke: np.ndarray, torsion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the tip's position ahead of BE and lateral to the cone's axis, (n,) each, m."""
        assert self.pair is not None
        assert self.scene is not None
        scene, pair = self.scene, self.pair
        x, y, theta = pair.chaser.T
        offset, length = scene.buffer.hinge_offset, scene.rest_length + stroke
        phi = theta + torsion
        rx = x + offset * np.cos(theta) + length * np.cos(phi) - pair.target[:, 0]
        ry = y + offset * np.sin(theta) + length * np.sin(phi) - pair.target[:, 1]
        c, s = np.cos(pair.target[:, 2]), np.sin(pair.target[:, 2])
        ahead, beside = -(c * rx + s * ry + scene.cone.L_T), c * ry - s * rx
        return ahead, beside

    @cached_property
    def stiff_gap(self) -> np.ndarray:
        """Running median of the distance of a tip on a stiff buffer to the walls, (k,), m."""
        assert self.pair is not None
        assert self.scene is not None
        zero = np.zeros(len(self.pair.t))
        ahead, beside = self._tip(zero, zero)
        R_c, L_c, cos_b, sin_b = self.scene.cone.wall
        gaps = []
        for side in (1.0, -1.0):
            u, Y = ahead, side * beside - R_c
            along = np.clip(u * cos_b + Y * sin_b, 0.0, L_c)
            gaps.append(np.hypot(u - along * cos_b, Y - along * sin_b))
        return smooth(np.minimum(*gaps), N_SMOOTH) - self.scene.probe.tip_radius

    @cached_property
    def stiff_depth(self) -> np.ndarray:
        """Running median of :meth:`depth` of a tip on a buffer that does not yield, (k,), m."""
        assert self.pair is not None
        zero = np.zeros(len(self.pair.t))
        return smooth(self.depth(zero, zero), N_SMOOTH)

    @cached_property
    def smooth_times(self) -> np.ndarray:
        """Times of running medians over the poses of :attr:`pair`, (k,), s."""
        assert self.pair is not None
        return smooth(self.pair.t, N_SMOOTH)

    @property
    def is_force_clear(self) -> bool:
        """True if the noise of the force hides no begin of a contact."""
        return self.force_onset is not None and self._force_limit <= _CLEAR

    @cached_property
    def force_onset(self) -> float | None:
        """When the force first leaves its zero, s; None if it never does."""
        force = self.force
        if force is None:
            return None
        kept = force.is_measured
        t, first = np.unique(force.t[kept], return_index=True)
        values = force.force[kept, :2][first]
        size = np.hypot(*(values - np.median(values, axis=0)).T)
        least = max(_MIN_FORCE, _FORCE_SHARE * float(size.max()))
        rest = values - baseline(t, values)  # moving vehicles shake: noise at rest is less
        least = max(least, 8.0 * float(np.median(np.hypot(*rest.T))) / 1.1774)
        self._force_limit = least
        found = onset(t, values, least)
        return None if found is None else found[0]

    @cached_property
    def contacts(self) -> dict[str, float]:
        """First contact by poses, buffer and force, s; a source without a contact is absent."""
        seen: dict[str, float] = {}
        if self.scene is None:
            return seen
        if self.pair is not None and len(self.stiff_depth):
            depth, t = self.stiff_depth, self.smooth_times
            # a tip that begins at the wall shows no begin of a contact
            away = depth < -(_AWAY + 6.0 * self.pose_noise)
            entered = (depth[1:] > 0.0) & np.isfinite(depth[:-1]) & (np.diff(t) < MAX_GAP)
            entered &= np.logical_or.accumulate(away)[:-1]
            if entered.any():
                k = int(np.argmax(entered))
                share = depth[k + 1] / (depth[k + 1] - min(depth[k], 0.0))
                seen["poses"] = float(t[k + 1] - share * (t[k + 1] - t[k]))
        buffer = self.buffer
        if buffer is not None:
            kept = buffer.is_measured
            t, first = np.unique(buffer.t[kept], return_index=True)
            length = self.scene.rest_length
            values = np.column_stack([buffer.stroke, length * buffer.torsion])[kept][first]
            begin = onset(t, values, MIN_DEFLECTION)
            if begin is not None:
                seen["buffer"] = begin[0]
        if self.force_onset is not None:
            seen["force"] = self.force_onset
        return seen

    @cached_property
    def near_time(self) -> float | None:
        """When the tip first comes as close to a wall as the noise of the poses, s; None if not."""
        if self.scene is None or self.pair is None or not len(self.stiff_gap):
            return None
        found = np.flatnonzero(self.stiff_gap < _NEAR + 3.0 * self.pose_noise)
        return float(self.smooth_times[found[0]]) if found.size else None

    def is_tracked(self, begin: float, end: float) -> bool:
        """Return True if poses cover a time, s, without a gap."""
        assert self.pair is not None
        t = self.pair.t[(self.pair.t >= begin) & (self.pair.t <= end)]
        steps = np.diff(np.concatenate([[begin], t, [end]]))
        return float(steps.max(initial=0.0)) < _TRACKED

    def topic_of(self, name: str) -> str:
        """Return the topic of poses, buffer or force."""
        channel = {"buffer": self.measured.buffer, "force": self.measured.force}.get(name)
        return self.pair_topic if channel is None else channel.topic

    @cached_property
    def cone_force(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Times (n,), s, and force on the tip in the target's axes, (n, 2), N; None if unknown."""
        force, pair = self.force, self.pair
        frame = None if force is None else frame_of(force.frame_ids)
        if force is None or pair is None or frame is None:
            return None
        kept = force.is_measured
        t, first = np.unique(force.t[kept], return_index=True)
        angle = -np.interp(t, pair.t, pair.target[:, 2])
        for name in FORCE_FRAMES[frame]:
            if name == "torsion":
                at = self.deflections_at(t)
                angle = angle + (0.0 if at is None else np.nan_to_num(at[1]))
            else:
                angle = angle + np.interp(t, pair.t, getattr(pair, name)[:, 2])
        x, y = -force.force[kept, :2][first].T  # the cell reads the force on the cone
        c, s = np.cos(angle), np.sin(angle)
        return t, np.column_stack([c * x - s * y, s * x + c * y])

    @cached_property
    def pose_noise(self) -> float:
        """Standard deviation of the tip's position by one pose of each vehicle, m."""
        if self.pair is None:
            return 0.0
        arm = 0.35 if self.scene is None else self.contact_distance
        lengths = [x for pose in (self.pair.chaser, self.pair.target) for x in pose.T[:2]]
        angles = [pose[:, 2] for pose in (self.pair.chaser, self.pair.target)]
        squares = sum(noise(x) ** 2 for x in lengths) / 2.0
        return float(np.sqrt(squares + sum((arm * noise(x)) ** 2 for x in angles)))


def _is_covered(t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return True for each time (n,) between two ascending ``u`` without gap, (n,) bool."""
    after = np.searchsorted(u, t, side="right").clip(1, max(len(u) - 1, 1))
    if len(u) < 2:
        return np.zeros(len(t), dtype=bool)
    return np.asarray((t >= u[0]) & (t <= u[-1]) & (u[after] - u[after - 1] <= MAX_GAP))
