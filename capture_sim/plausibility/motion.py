"""Motion of the vehicles and of the tip from measurements, computed once for all rules.

Times are stamps in s, and count from the origin of the :class:`Measured`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from capture_sim.plausibility.axes import FORCE_FRAMES, frame_of
from capture_sim.plausibility.measured import Channel, Deflections, Forces, Measured, Poses
from capture_sim.plausibility.signals import (
    AWAY,
    MIN_REST,
    baseline,
    noise,
    onset,
    rest_of,
    smooth,
    zero_of,
)
from capture_sim.scene.parts import Scene

#: Values are interpolated only between measurements that are at most this far apart, s.
MAX_GAP = 0.25
#: Number of poses over which running medians are taken before a comparison with the walls.
N_SMOOTH = 9
#: Least number of messages with which a source is used: its noise is not known from fewer.
MIN_MESSAGES = 8
#: Poses that are less than this apart, s, show every contact.
_TRACKED = 0.05
#: A contact begins with a force above the first number, N, and above this share of the largest.
_MIN_FORCE, _FORCE_SHARE = 2.0, 0.05
#: If noise requires a threshold above this, N, the force may not show the begin of a contact.
_CLEAR = 3.0
#: Least rate at which a force shows the first touches of a contact, Hz.
_MIN_FORCE_RATE = 800.0
#: Least deflection of the buffer that begins a contact, m.
MIN_DEFLECTION = 3e-4
#: A tip this close to a wall may touch it, m: base frames are no better.
_NEAR = 3e-3


class PosePair(NamedTuple):
    """Poses of both vehicles' base frames at common times, the stamps of the chaser's poses."""

    t: np.ndarray  # (n,), s, ascending
    chaser: np.ndarray  # (n, 3): x, y (m), heading (rad)
    target: np.ndarray  # (n, 3): x, y (m), heading (rad), interpolated
    z_chaser: np.ndarray  # (n,), m
    z_target: np.ndarray  # (n,), m


class MeasuredMotion:
    """Motion of one bench by its measurements, and by its scene (None if it is not known).

    Most properties are computed at their first use and then kept.
    """

    def __init__(self, measured: Measured, scene: Scene | None) -> None:
        self.measured, self.scene = measured, scene
        self._made: dict[str, Any] = {}
        self._force_limit = 0.0  # N, that a force must pass to begin a contact

    def once(self, name: str, make: Callable[[], Any]) -> Any:
        """Return what ``make`` returned for ``name``; call it only if the name is new."""
        if name not in self._made:
            self._made[name] = make()
        return self._made[name]

    @property
    def chaser(self) -> Poses | None:
        """Poses of the chaser; None if none were measured."""
        return self.measured.chaser

    @property
    def target(self) -> Poses | None:
        """Poses of the target; None if none were measured."""
        return self.measured.target

    @cached_property
    def buffer(self) -> Deflections | None:
        """States of the buffer; None if fewer than ``MIN_MESSAGES`` are measured."""
        buffer = self.measured.buffer
        return buffer if buffer is not None and buffer.is_measured.sum() >= MIN_MESSAGES else None

    @cached_property
    def force(self) -> Forces | None:
        """Forces; None if their frame is unknown, or if under ``MIN_MESSAGES`` are measured."""
        force = self.measured.force
        if force is None or frame_of(force.frame_ids) is None:
            return None
        return force if force.is_measured.sum() >= MIN_MESSAGES else None

    @cached_property
    def pair(self) -> PosePair | None:
        """Poses of both vehicles at the chaser's stamps; None if there are too few.

        The target's poses are interpolated.  Stamps outside of the target's poses, and in gaps of
        them longer than ``MAX_GAP``, are left out.  Too few are less than ``MIN_MESSAGES``.
        """
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
        """Topics of the chaser's and the target's poses as one text, joined by " and "."""
        names = [poses.topic for _, poses in self.measured.vehicles]
        return " and ".join(dict.fromkeys(names))

    @cached_property
    def distance(self) -> np.ndarray:
        """Distance between the base frames in the plane, (n,), m, at the times of :attr:`pair`.

        Empty if :attr:`pair` is None.
        """
        if self.pair is None:
            return np.zeros(0)
        x, y = (self.pair.target[:, :2] - self.pair.chaser[:, :2]).T
        return np.asarray(np.hypot(x, y))

    @cached_property
    def contact_distance(self) -> float:
        """Distance between the base frames with the tip's centre at the centre of BE, m.

        The buffer is undeflected, and both vehicles are aligned with the cone's axis.  Needs a
        scene.
        """
        assert self.scene is not None
        return self.scene.buffer.hinge_offset + self.scene.rest_length + self.scene.cone.L_T

    @cached_property
    def approach(self) -> np.ndarray:
        """True for each pose of :attr:`pair` in the approach, (n,) bool; empty without a pair.

        The approach ends where the distance first falls to its 2nd percentile, which is near the
        closest approach.  The first ``MIN_MESSAGES`` poses always belong to it.
        """
        found = np.zeros(len(self.distance), dtype=bool)
        if len(self.distance):
            nearest = self.distance <= np.percentile(self.distance, 2.0)
            found[: max(int(np.argmax(nearest)), MIN_MESSAGES)] = True
        return found

    def deflections_at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return stroke (m) and torsion (rad) at the times ``t``, s, (n,) each, interpolated.

        They are NaN outside of the encoders' stamps, and in gaps longer than ``MAX_GAP``.  None if
        :attr:`buffer` is None.
        """
        buffer = self.buffer
        if buffer is None:
            return None
        kept = buffer.is_measured
        u, first = np.unique(buffer.t[kept], return_index=True)
        inside = _is_covered(t, u)
        stroke, torsion = (
            np.where(inside, np.interp(t, u, x[kept][first]) - zero, np.nan)
            for x, zero in zip((buffer.stroke, buffer.torsion), self.zero, strict=True)
        )
        return stroke, torsion

    @cached_property
    def zero(self) -> tuple[float, float]:
        """What the buffer's encoders show at rest before the first contact: m, rad.

        See :func:`capture_sim.plausibility.signals.zero_of`.  0 without a scene or poses.
        """
        if self.scene is None:
            return 0.0, 0.0
        return zero_of(self._at_rest, self.scene.rest_length)

    @cached_property
    def zero_error(self) -> np.ndarray:
        """Largest plausible error that :attr:`zero` leaves in stroke (m) and torsion (rad), (2,).

        It is three standard errors, and a zero too small to be subtracted; infinite if too few
        states are at rest.
        """
        if len(self._at_rest) < MIN_REST:
            return np.full(2, np.inf)
        middle, errors = rest_of(self._at_rest)
        return np.abs(middle - self.zero) + 3.0 * errors

    @cached_property
    def _at_rest(self) -> np.ndarray:
        """Strokes and torsions while the tip is ahead of the cone's mouth in the approach, (n, 2).

        (0, 2) without a scene, poses or a buffer.
        """
        if self.buffer is None or self.scene is None or self.pair is None:
            return np.zeros((0, 2))
        kept = self.buffer.is_measured
        t, values = self.buffer.t[kept], self.buffer.values[kept]
        order = np.argsort(t, kind="stable")
        t, values = t[order], values[order]
        nothing = np.zeros(len(self.pair.t))
        ahead = np.interp(t, self.pair.t, self.tip(nothing, nothing)[0])
        before = (t >= self.pair.t[0]) & (t <= self.pair.t[self.approach][-1])
        return np.asarray(values[before & (ahead > self.scene.cone.mouth + AWAY)])

    def depth(self, stroke: np.ndarray, torsion: np.ndarray) -> np.ndarray:
        """Return the depth of the tip in a wall, (n,), m, the larger of those in both walls.

        ``stroke`` (m) and ``torsion`` (rad), (n,) each, are those of the buffer at the times of
        :attr:`pair`; poses give the rest.  The depth is the tip's radius less the distance of its
        centre from the wall: negative if the tip does not reach the wall.

        It is minus infinity where the tip is not alongside a wall, and as long as it has not been
        clear of the wall on the wall's inner side.  A tip that passes the cone outside of it thus
        counts as in no wall.  It is minus infinity also where stroke or torsion is NaN.
        """
        assert self.pair is not None
        assert self.scene is not None
        scene = self.scene
        ahead, beside = self.tip(stroke, torsion)
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

    def tip(self, stroke: np.ndarray, torsion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the position of the tip's centre relative to the centre of BE, (n,) each, m.

        The first array is the position along the cone's axis, positive towards the cone's mouth.
        The second is the position across the axis, positive along the target's y axis.
        """
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
        """Running median of the distance from the tip's surface to the nearest wall, (k,), m.

        The tip is placed by poses alone, as if the buffer were rigid.  The values are at
        :attr:`smooth_times`.
        """
        assert self.pair is not None
        assert self.scene is not None
        zero = np.zeros(len(self.pair.t))
        ahead, beside = self.tip(zero, zero)
        R_c, L_c, cos_b, sin_b = self.scene.cone.wall
        gaps = []
        for side in (1.0, -1.0):
            u, Y = ahead, side * beside - R_c
            along = np.clip(u * cos_b + Y * sin_b, 0.0, L_c)
            gaps.append(np.hypot(u - along * cos_b, Y - along * sin_b))
        return smooth(np.minimum(*gaps), N_SMOOTH) - self.scene.probe.tip_radius

    @cached_property
    def stiff_depth(self) -> np.ndarray:
        """Running median of :meth:`depth` with stroke and torsion 0, (k,), m.

        It is the depth of the tip as if the buffer were rigid.  The values are at
        :attr:`smooth_times`.
        """
        assert self.pair is not None
        zero = np.zeros(len(self.pair.t))
        return smooth(self.depth(zero, zero), N_SMOOTH)

    @cached_property
    def smooth_times(self) -> np.ndarray:
        """Times of running medians over ``N_SMOOTH`` poses of :attr:`pair`, (k,), s."""
        assert self.pair is not None
        return smooth(self.pair.t, N_SMOOTH)

    @property
    def is_force_clear(self) -> bool:
        """True if the force leaves its zero, and neither noise nor rate can hide a contact's begin.

        The noise is small enough if the threshold for the begin is at most 3 N.  Below 800 samples
        a second, the first touches may all lie between samples.
        """
        force = self.force
        if force is None or self.force_onset is None or self._force_limit > _CLEAR:
            return False
        return float(np.median(np.diff(np.sort(force.t)))) <= 1.0 / _MIN_FORCE_RATE

    @cached_property
    def force_onset(self) -> float | None:
        """Time at which the force first leaves its baseline, s; None if it never does.

        None also if :attr:`force` is None.  The baseline follows a slow drift of the zero.  The
        threshold is at least 2 N, 5 % of the largest force, and 8 standard deviations of the noise.
        """
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
        """Time of the first contact, s, by each source that shows one.

        The keys are "poses", "buffer" and "force".  A source that shows no contact has no key.
        Empty without a scene.  By poses, the contact begins where the tip would enter a wall if the
        buffer were rigid.
        """
        seen: dict[str, float] = {}
        if self.scene is None:
            return seen
        if self.pair is not None and len(self.stiff_depth):
            depth, t = self.stiff_depth, self.smooth_times
            # a tip that begins at the wall shows no begin of a contact
            away = depth < -(AWAY + 6.0 * self.pose_noise)
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
        """Time at which the tip first comes so close to a wall that it may touch it, s.

        So close is 3 mm, for errors of the base frames, and 3 standard deviations of the poses.
        None if the tip never does, without a scene, or without poses of both vehicles.
        """
        if self.scene is None or self.pair is None or not len(self.stiff_gap):
            return None
        found = np.flatnonzero(self.stiff_gap < _NEAR + 3.0 * self.pose_noise)
        return float(self.smooth_times[found[0]]) if found.size else None

    def is_tracked(self, begin: float, end: float, by: Channel | None = None) -> bool:
        """Return True if poses, or a source, cover ``begin`` to ``end``, s, without a gap.

        A gap is 0.05 s or longer.  True also if ``end`` is not after ``begin``.
        """
        assert self.pair is not None
        t = self.pair.t if by is None else np.sort(by.t[by.is_measured])
        t = t[(t >= begin) & (t <= end)]
        steps = np.diff(np.concatenate([[begin], t, [end]]))
        return float(steps.max(initial=0.0)) < _TRACKED

    def topic_of(self, name: str) -> str:
        """Return the topic of a source; ``name`` is "poses", "buffer" or "force".

        For "poses", and for a source that was not measured, it is :attr:`pair_topic`.
        """
        channel = {"buffer": self.measured.buffer, "force": self.measured.force}.get(name)
        return self.pair_topic if channel is None else channel.topic

    @cached_property
    def cone_force(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Times (n,), s, and force on the tip, x and y in the target's axes, (n, 2), N.

        The force on the tip is opposite to that on the cone, which the load cell measures.  An
        unknown torsion counts as 0.  None without forces in a known frame, or without :attr:`pair`.
        """
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
        """Standard deviation of the tip's position relative to the cone by single poses, m.

        It combines the noise of both vehicles' positions and headings.  0 without :attr:`pair`.
        """
        if self.pair is None:
            return 0.0
        arm = 0.35 if self.scene is None else self.contact_distance
        lengths = [x for pose in (self.pair.chaser, self.pair.target) for x in pose.T[:2]]
        angles = [pose[:, 2] for pose in (self.pair.chaser, self.pair.target)]
        squares = sum(noise(x) ** 2 for x in lengths) / 2.0
        return float(np.sqrt(squares + sum((arm * noise(x)) ** 2 for x in angles)))


def _is_covered(t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return True for each time ``t`` that measurements at the times ``u`` cover, (n,) bool.

    A time is covered if it is between two successive times of ``u``, which are ascending, and these
    are at most ``MAX_GAP`` apart.
    """
    after = np.searchsorted(u, t, side="right").clip(1, max(len(u) - 1, 1))
    if len(u) < 2:
        return np.zeros(len(t), dtype=bool)
    return np.asarray((t >= u[0]) & (t <= u[-1]) & (u[after] - u[after - 1] <= MAX_GAP))
