"""Frames in whose axes a measured force may be given, by the ``frame_id`` of its messages."""

from __future__ import annotations

from collections.abc import Mapping

#: By frame_id, the measured angles whose sum turns the world's axes into the axes of the frame.
FORCE_FRAMES: Mapping[str, tuple[str, ...]] = {
    "chaser/tip": ("chaser", "torsion"),
    "chaser/base_link": ("chaser",),
    "target/cone": ("target",),
    "target/base_link": ("target",),
    "world": (),
}


def frame_of(frame_ids: tuple[str, ...]) -> str | None:
    """Return the frame of a force as a key of :data:`FORCE_FRAMES`; None if it is not known.

    ``frame_ids`` are the different ``frame_id`` texts of a topic's messages.  Leading slashes do
    not count.  The frame is not known if it is no key of :data:`FORCE_FRAMES`, or if the texts name
    more than one frame, an empty text beside a name included.  If there is no text, or if it is
    empty, the frame is taken to be ``target/cone``.
    """
    names = {name.lstrip("/") for name in frame_ids} or {""}
    if len(names) > 1:
        return None
    [name] = names
    if not name:
        return "target/cone"
    return name if name in FORCE_FRAMES else None
