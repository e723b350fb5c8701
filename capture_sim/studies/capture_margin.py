"""How far an approach may be off before a capture is lost."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from capture_sim.errors import SceneError
from capture_sim.scene.parts import Scene
from capture_sim.studies.approach import approach_of, placed
from capture_sim.studies.verdict import run_to_verdict

#: Multiples of the spread that are tried, in order.
SCALES = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0)


@dataclass(frozen=True)
class Spread:
    """How far approaches differ from the one that is meant.

    Attributes
    ----------
    speed : float
        Part of the speed.
    offset : float
        m.
    angle : float
        rad.

    Raises
    ------
    SceneError
        A value is out of its range.
    """

    speed: float = 0.1
    offset: float = 2e-3
    angle: float = 0.02

    def __post_init__(self) -> None:
        for name, unit, high in (
            ("speed", "", 0.24),
            ("offset", " m", 1.0),
            ("angle", " rad", 0.3),
        ):
            value = getattr(self, name)
            if not 0.0 <= value <= high:
                raise SceneError(f"spread.{name} = {value!r}{unit}: allowed is >= 0 and <= {high}")
        if not (self.speed or self.offset or self.angle):
            raise SceneError("spread: speed, offset and angle are 0: allowed is one above 0")


def corners(spread: Spread) -> list[tuple[float, float, float]]:
    """Return the corners, edges and faces of the box of a spread: angle, offset, speed each.

    Parts that do not differ are left out, so that nothing is run twice.
    """
    sides = [(-v, 0.0, v) if v else (0.0,) for v in (spread.angle, spread.offset, spread.speed)]
    return [(a, o, s) for a, o, s in itertools.product(*sides) if a or o or s]


def captures(scene: Scene, spread: Spread, scale: float) -> bool:
    """Whether every approach on the surface of ``scale`` times the spread ends in a capture."""
    angle, offset, speed = approach_of(scene)
    for d_angle, d_offset, d_speed in corners(spread):
        off = placed(
            scene, angle + scale * d_angle, offset + scale * d_offset, speed * (1 + scale * d_speed)
        )
        if off is None:
            return False
        outcome = run_to_verdict(off)
        if outcome.failed or not outcome.captured:
            return False
    return True


def margin_of(scene: Scene, spread: Spread) -> float:
    """Return how many times a spread the approach may be off with every capture kept.

    Of the multiples in :data:`SCALES`, the last before the first that loses a capture at a
    corner, edge or face of the box; 0 if the smallest does.
    """
    kept = 0.0
    for scale in SCALES:
        if not captures(scene, spread, scale):
            break
        kept = scale
    return kept
