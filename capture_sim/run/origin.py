"""The origin of a run: its source, the software that made it, and how its release was found."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import TYPE_CHECKING, Any

from capture_sim.base.software import scene_hash, software_versions
from capture_sim.scene.loading import overrides_of

if TYPE_CHECKING:
    from capture_sim.scene.parts import Scene


class Release(Enum):
    """How the time of the release, t = 0, was determined."""

    STAMP = auto()  # from a recorded stamp by the clock of the poses, or a simulated run
    ARRIVAL = auto()  # from the arrival of the release, or of the trial's announcement
    GIVEN = auto()  # by the user, in s after the first pose
    BEGINNING = auto()  # no release recorded: the first pose counts, or the first message


@dataclass(frozen=True)
class Origin:
    """Origin of a run: its source, scene, overrides and software."""

    path: str = ""  # of the recording; empty for a run of :func:`capture_sim.simulate`
    recorded_software: tuple[str, ...] | None = None  # None: the run was made by this process
    # of the text of the recorded scene, which another version may write with other fields; empty
    # for a run of :func:`capture_sim.simulate`
    scene_sha256: str = ""
    release: Release = Release.STAMP
    after_first_pose: float = 0.0  # s, time from the first pose to the release
    problems: tuple[str, ...] = ()  # why the recording is incomplete, one line each
    left_out: tuple[str, ...] = ()  # topics that cannot be read, one line each

    @property
    def software(self) -> tuple[str, ...]:
        """Software that made the run, as texts ``"name version"``.

        For a run of this process the first access is slow, because it asks git for the version.
        """
        if self.recorded_software is not None:
            return self.recorded_software
        return tuple(software_versions())


def scene_origin(scene: Scene, sha256: str = "") -> dict[str, Any]:
    """Return the name, the overrides and the hash of a scene, and the seed of its sensors.

    The keys are those of ``made_by`` in results.json.  The seed is None for a scene without
    sensors.  ``sha256`` is the hash of the scene as it was recorded; if it is empty, the hash of
    the scene's present text is returned.
    """
    return {
        "scene": scene.name,
        "overrides": overrides_of(scene),
        "scene_sha256": sha256 or scene_hash(scene.to_yaml()),
        "seed": None if scene.sensors is None else scene.sensors.seed,
    }
