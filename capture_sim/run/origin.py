"""Where a run comes from, how it was made, and how its release was found."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import TYPE_CHECKING, Any

from capture_sim.base.software import scene_hash, software_versions
from capture_sim.scene.loading import overrides_of

if TYPE_CHECKING:
    from capture_sim.scene.parts import Scene


class Release(Enum):
    """Source of the release time, t = 0."""

    STAMP = auto()  # recorded, and stamped by the clock of the poses
    ARRIVAL = auto()  # recorded by its arrival only, or the trial's announcement in its place
    GIVEN = auto()  # by the user, after the first pose
    BEGINNING = auto()  # not recorded: the first pose, without poses the first message


@dataclass(frozen=True)
class Origin:
    """Origin of a run: its source, scene, overrides and software."""

    path: str = ""  # of the recording; empty for a run of :func:`capture_sim.simulate`
    recorded_software: tuple[str, ...] | None = None  # None: the run was made by this process
    # of the recorded scene, as the version that recorded it wrote it: a scene gains fields; empty
    # for a run of :func:`capture_sim.simulate`
    scene_sha256: str = ""
    release: Release = Release.STAMP
    after_first_pose: float = 0.0  # s, of the release
    problems: tuple[str, ...] = ()  # why the recording is incomplete, one line each
    left_out: tuple[str, ...] = ()  # topics that cannot be read, one line each

    @property
    def software(self) -> tuple[str, ...]:
        """Software that made the run, ``"name version"`` each; asking git is slow."""
        if self.recorded_software is not None:
            return self.recorded_software
        return tuple(software_versions())


def scene_origin(scene: Scene, sha256: str = "") -> dict[str, Any]:
    """Return name, overrides and hash of a scene, and the seed of its sensors (None without).

    ``sha256`` is the hash of the scene as it was recorded; without one, of its text today.
    """
    return {
        "scene": scene.name,
        "overrides": overrides_of(scene),
        "scene_sha256": sha256 or scene_hash(scene.to_yaml()),
        "seed": None if scene.sensors is None else scene.sensors.seed,
    }
