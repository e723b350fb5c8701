"""Measurements of a bench's sensors as arrays, for the rules of plausibility."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np


def _nothing() -> np.ndarray:
    return np.zeros(0)


#: Quaternions below this norm are no orientation.
MIN_NORM = 1e-3


@dataclass(frozen=True, eq=False)
class Channel:
    """Messages of one topic, in the order in which they were received; n is their number."""

    topic: str  # as the user knows it
    t: np.ndarray  # (n,), s, stamps less :attr:`Measured.origin`
    arrival: np.ndarray = field(
        default_factory=_nothing
    )  # (n,), s, arrivals less the origin; (0,) if they are not known
    frame_ids: tuple[str, ...] = ()  # every header.frame_id of the topic, each once

    @property
    def count(self) -> int:
        """Number of messages."""
        return len(self.t)

    @property
    def values(self) -> np.ndarray:
        """Measured values of the messages, (n, m), with m values in each message."""
        raise NotImplementedError

    @cached_property
    def is_measured(self) -> np.ndarray:
        """True for each message whose values are all finite, (n,) bool."""
        return np.asarray(np.isfinite(self.values).all(axis=1))

    @property
    def logged(self) -> np.ndarray:
        """Arrivals of the messages, (n,), s; their stamps if the arrivals are not known."""
        return self.arrival if self.arrival.size else self.t


@dataclass(frozen=True, eq=False)
class Poses(Channel):
    """Poses of one vehicle's base frame in the frame that ``frame_ids`` names."""

    position: np.ndarray = field(default_factory=_nothing)  # (n, 3), m
    quaternion: np.ndarray = field(default_factory=_nothing)  # (n, 4): x, y, z, w

    @property
    def values(self) -> np.ndarray:
        """Positions (m) and quaternions, (n, 7): x, y, z, then the quaternion's x, y, z, w."""
        return np.concatenate([self.position, self.quaternion], axis=1)

    @cached_property
    def norm(self) -> np.ndarray:
        """Norms of the quaternions, (n,); 1 for a proper orientation."""
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", self.quaternion, self.quaternion)))

    @cached_property
    def is_measured(self) -> np.ndarray:
        """True for each message with a pose, (n,) bool.

        A pose has finite values and a quaternion whose norm is above ``MIN_NORM``.
        """
        return np.asarray(np.isfinite(self.values).all(axis=1) & (self.norm > MIN_NORM))

    @cached_property
    def planar(self) -> np.ndarray:
        """x, y (m) and heading (rad, without jumps by a turn), (k, 3).

        Only the k messages that :attr:`is_measured` marks have a row.
        """
        kept = self.is_measured
        heading = 2.0 * np.arctan2(self.quaternion[kept, 2], self.quaternion[kept, 3])
        return np.column_stack([self.position[kept, :2], np.unwrap(heading)])

    @cached_property
    def tilt(self) -> np.ndarray:
        """Angle between the vehicle's z axis and the world's, (k,), rad, in 0 to pi.

        Only the k messages that :attr:`is_measured` marks have a value.
        """
        x, y, _, _ = (self.quaternion[self.is_measured] / self.norm[self.is_measured, None]).T
        return np.asarray(2.0 * np.arcsin(np.minimum(np.hypot(x, y), 1.0)))


@dataclass(frozen=True, eq=False)
class Deflections(Channel):
    """Measured states of the buffer: stroke and torsion."""

    unused: str = ""  # the reason, if none of the topic's messages has a state of the buffer
    stroke: np.ndarray = field(default_factory=_nothing)  # (n,), m, negative when compressed
    torsion: np.ndarray = field(default_factory=_nothing)  # (n,), rad

    @cached_property
    def values(self) -> np.ndarray:  # type: ignore[override]
        """Strokes (m) and torsions (rad), (n, 2)."""
        return np.column_stack([self.stroke, self.torsion])


@dataclass(frozen=True, eq=False)
class Forces(Channel):
    """Forces on the cone, as the load cell sends them."""

    force: np.ndarray = field(default_factory=_nothing)  # (n, 3), N, in the axes of ``frame_ids``

    @property
    def values(self) -> np.ndarray:
        """Forces, (n, 3): x, y, z in N, in the axes of the frame that ``frame_ids`` names."""
        return self.force


@dataclass(frozen=True, eq=False)
class Measured:
    """Measurements of the sources of one bench: a topic each for both vehicles, buffer and force.

    A source without messages is None, or has a count of 0.  All times are in s after one
    ``origin``, because seconds since 1970 would lose digits as floating-point numbers.
    ``is_before_release`` is True if the launcher still holds the chaser, so that no vehicle moves
    and the tip touches no wall.
    """

    chaser: Poses | None = None
    target: Poses | None = None
    buffer: Deflections | None = None
    force: Forces | None = None
    origin: int = 0  # ns, of every time
    is_before_release: bool = False
    release: float = 0.0  # s, t = 0 of the run

    @property
    def channels(self) -> list[Channel]:
        """Sources with at least one message, in the order of the fields."""
        values = (getattr(self, each.name) for each in fields(self))
        return [each for each in values if isinstance(each, Channel) and each.count]

    @property
    def vehicles(self) -> Iterator[tuple[str, Poses]]:
        """Pairs of "chaser" or "target" and its poses, without vehicles that have no message."""
        for name, poses in (("chaser", self.chaser), ("target", self.target)):
            if poses is not None and poses.count:
                yield name, poses
