"""Measurements of a bench's sensors, as the rules use them."""

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
    """Messages of one topic, in the order of their arrival."""

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
        """Values of the messages, (n, m)."""
        raise NotImplementedError

    @cached_property
    def is_measured(self) -> np.ndarray:
        """Which messages hold a measurement, (n,) bool."""
        return np.asarray(np.isfinite(self.values).all(axis=1))

    @property
    def logged(self) -> np.ndarray:
        """Arrivals, (n,), s; stamps where they are not known."""
        return self.arrival if self.arrival.size else self.t


@dataclass(frozen=True, eq=False)
class Poses(Channel):
    """Poses of one vehicle in the world."""

    position: np.ndarray = field(default_factory=_nothing)  # (n, 3), m
    quaternion: np.ndarray = field(default_factory=_nothing)  # (n, 4): x, y, z, w

    @property
    def values(self) -> np.ndarray:
        """Positions and quaternions, (n, 7)."""
        return np.concatenate([self.position, self.quaternion], axis=1)

    @cached_property
    def norm(self) -> np.ndarray:
        """Norms of the quaternions, (n,)."""
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", self.quaternion, self.quaternion)))

    @cached_property
    def is_measured(self) -> np.ndarray:
        """Which messages hold a pose, (n,) bool."""
        return np.asarray(np.isfinite(self.values).all(axis=1) & (self.norm > MIN_NORM))

    @cached_property
    def planar(self) -> np.ndarray:
        """x, y (m) and heading (rad, unwrapped) of the messages that hold a pose, (k, 3)."""
        kept = self.is_measured
        heading = 2.0 * np.arctan2(self.quaternion[kept, 2], self.quaternion[kept, 3])
        return np.column_stack([self.position[kept, :2], np.unwrap(heading)])

    @cached_property
    def tilt(self) -> np.ndarray:
        """Angle between the vehicle's z axis and the world's, (k,), rad."""
        x, y, _, _ = (self.quaternion[self.is_measured] / self.norm[self.is_measured, None]).T
        return np.asarray(2.0 * np.arcsin(np.minimum(np.hypot(x, y), 1.0)))


@dataclass(frozen=True, eq=False)
class Deflections(Channel):
    """State of the buffer."""

    unused: str = ""  # why messages of the topic give no state, if none does
    stroke: np.ndarray = field(default_factory=_nothing)  # (n,), m, negative when compressed
    torsion: np.ndarray = field(default_factory=_nothing)  # (n,), rad

    @cached_property
    def values(self) -> np.ndarray:  # type: ignore[override]
        """Strokes and torsions, (n, 2)."""
        return np.column_stack([self.stroke, self.torsion])


@dataclass(frozen=True, eq=False)
class Forces(Channel):
    """Forces of the load cell as it sends them, on the cone."""

    force: np.ndarray = field(default_factory=_nothing)  # (n, 3), N, in the axes of ``frame_ids``

    @property
    def values(self) -> np.ndarray:
        """Forces, (n, 3), N."""
        return self.force


@dataclass(frozen=True, eq=False)
class Measured:
    """One topic of each source of a bench; None for a source that nothing was received of.

    All times count from one origin, ns, so that stamps of a wall clock keep their digits.
    ``is_before_release``: nothing has been let go, so that nothing moves and nothing touches.
    """

    chaser: Poses | None = None
    target: Poses | None = None
    buffer: Deflections | None = None
    force: Forces | None = None
    origin: int = 0  # ns, of every time
    is_before_release: bool = False

    @property
    def channels(self) -> list[Channel]:
        """The sources that messages were received of."""
        values = (getattr(self, each.name) for each in fields(self))
        return [each for each in values if isinstance(each, Channel) and each.count]

    @property
    def vehicles(self) -> Iterator[tuple[str, Poses]]:
        """Poses of chaser and target, by name, where messages were received."""
        for name, poses in (("chaser", self.chaser), ("target", self.target)):
            if poses is not None and poses.count:
                yield name, poses
