"""Axes that a force may be in, by its frame_id."""

from __future__ import annotations

from collections.abc import Mapping

#: Axes that a force may be in, by frame_id: the measured angles that they are turned by.
FORCE_FRAMES: Mapping[str, tuple[str, ...]] = {
    "chaser/tip": ("chaser", "torsion"),
    "chaser/base_link": ("chaser",),
    "target/cone": ("target",),
    "target/base_link": ("target",),
    "world": (),
}


def frame_of(frame_ids: tuple[str, ...]) -> str | None:
    """Return the frame of a force, without a leading slash; None if it is not one of the list.

    An empty one is ``target/cone``.
    """
    names = {name.lstrip("/") for name in frame_ids} or {""}
    if len(names) > 1:
        return None
    [name] = names
    if not name:
        return "target/cone"
    return name if name in FORCE_FRAMES else None
