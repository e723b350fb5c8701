"""What a design may choose: free values of a scene, each with the range that is searched."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from capture_sim.errors import SceneError
from capture_sim.scene import paths
from capture_sim.scene.approach import APPROACH, approach_of
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import accept
from capture_sim.scene.units import in_si
from capture_sim.studies.axes import declaration_of
from capture_sim.studies.limits import Limit

#: Values that are searched unless others are named.
FREE = ("buffer.k_A", "buffer.k_T", "buffer.c_A")
#: Values that act on the torsion: where one is free, its torque is an objective by default.
TORSIONAL = ("buffer.k_T", "buffer.k_T3", "buffer.c_T", "buffer.c_T2")
#: Values that a table of the spring's force replaces.
_OF_AXIAL_SPRING = ("buffer.k_A", "buffer.k_A3", "buffer.preload")
#: Strokes where no limit is given, m and rad, as measures of the ranges only.
_USUAL_STROKE, _USUAL_TORSION = 0.02, 0.01


@dataclass(frozen=True)
class Variable:
    """A free value and the range that is searched; on a logarithmic scale if both ends are > 0."""

    name: str
    low: float
    high: float
    unit: str = ""

    def value(self, share: float) -> float:
        """Return the value at a share of the range, 0 to 1."""
        if self.low > 0.0:
            return float(self.low * (self.high / self.low) ** share)
        return float(self.low + (self.high - self.low) * share**3)

    def share(self, value: float) -> float:
        """Return the share of the range at a value."""
        inside = min(max(value, self.low), self.high)
        if self.low > 0.0:
            return math.log(inside / self.low) / math.log(self.high / self.low)
        return float(((inside - self.low) / (self.high - self.low)) ** (1.0 / 3.0))


def make_variables(
    scene: Scene, limits: Sequence[Limit], free: Sequence[str]
) -> tuple[Variable, ...]:
    """Return the values to search with their ranges.

    Ranges that are not given are those around a buffer that absorbs the energy of the approach
    within the limits of its strokes.  SceneError if a name or a range is invalid.
    """
    usual = _usual_ranges(scene, limits)
    variables: list[Variable] = []
    for text in free:
        name, _, given = (part.strip() for part in text.partition("="))
        what = declaration_of(scene, name)
        if name in APPROACH or what.kind is not float:
            raise SceneError(f"free {name}: must be a number of the scene")
        if scene.buffer.force_table is not None and name in _OF_AXIAL_SPRING:
            raise SceneError(
                f"free {name}: must not be free with buffer.force_table, which gives the spring"
            )
        if given:
            low, colon, high = given.partition(":")
            try:
                if not colon:
                    raise ValueError(given)
                ends = in_si(low, what.unit), in_si(high, what.unit)
            except ValueError:
                raise SceneError(
                    f"free {name} = {given}: must be LOW:HIGH in {what.unit or '1'}"
                ) from None
        elif name in usual:
            ends = usual[name]
        else:
            raise SceneError(f"free {name}: must have a range, {name}=LOW:HIGH")
        for end in ends:
            accept(end, what, f"free {name}")
        if not ends[0] < ends[1]:
            raise SceneError(f"free {name} = {given}: must be LOW < HIGH")
        if name in (variable.name for variable in variables):
            raise SceneError(f"free {name}: must be given once")
        variables.append(Variable(name, *ends, what.unit))
    if not variables:
        raise SceneError("free: must have one value or more")
    return tuple(variables)


def reduced_mass(scene: Scene) -> float:
    """Return the reduced mass of both vehicles, kg."""
    chaser, target = scene.chaser_total_mass, scene.target.mass
    return chaser * target / (chaser + target)


def _usual_ranges(scene: Scene, limits: Sequence[Limit]) -> dict[str, tuple[float, float]]:
    """Return ranges around a buffer that absorbs the approach's energy within its strokes."""
    given = {limit.key.removesuffix("_before_latch"): limit.value for limit in limits}
    stroke = given.get("max_axial_stroke_in", _USUAL_STROKE)
    torsion = given.get("max_torsion", _USUAL_TORSION)
    speed = approach_of(scene).speed
    k_A = reduced_mass(scene) * (speed / stroke) ** 2
    c_A = 2.0 * reduced_mass(scene) * speed / stroke  # critical on that spring
    k_T = k_A * stroke * scene.rest_length / torsion
    c_T = k_T * torsion * scene.rest_length / speed
    turning = speed / scene.rest_length
    return {
        "buffer.k_A": (k_A / 50.0, k_A * 20.0),
        "buffer.k_T": (k_T / 100.0, k_T * 100.0),
        "buffer.c_A": (c_A / 300.0, c_A * 10.0),
        "buffer.c_A_rebound": (c_A / 300.0, c_A * 10.0),
        "buffer.preload": (0.0, k_A * stroke),
        "buffer.friction": (0.0, k_A * stroke),
        "buffer.k_A3": (0.0, 100.0 * k_A / stroke**2),
        "buffer.c_A2": (0.0, 10.0 * c_A / speed),
        "buffer.c_T": (0.0, 10.0 * c_T),
        "buffer.k_T3": (0.0, 100.0 * k_T / torsion**2),
        "buffer.c_T2": (0.0, 10.0 * c_T / turning),
    }


def with_values(scene: Scene, values: Mapping[str, float]) -> Scene:
    """Return a scene with other values; a rebound damper keeps its ratio to the damper."""
    changed: Scene = paths.with_values(scene, {**values, **rebound_of(scene, values)})
    return changed


def rebound_of(scene: Scene, values: Mapping[str, float]) -> dict[str, float]:
    """Return the rebound damper that belongs to a damper, by its name; empty if there is none."""
    own = scene.buffer
    name = "buffer.c_A_rebound"
    if own.c_A_rebound is None or own.c_A == 0.0 or name in values or "buffer.c_A" not in values:
        return {}
    return {name: own.c_A_rebound / own.c_A * values["buffer.c_A"]}
