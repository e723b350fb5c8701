"""Free values of a design: the values of a scene that it may choose, and their ranges."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

from capture_sim.errors import SceneError
from capture_sim.scene import paths
from capture_sim.scene.approach import APPROACH, approach_of
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import POSITIVE, Declared, accept
from capture_sim.studies.evaluate.limits import Limit
from capture_sim.studies.vary.inputs import FORMS_OF_DESIGN, Input, declaration_of, read_input

#: Free values by default.
FREE = ("buffer.k_A", "buffer.k_T", "buffer.c_A")
#: Values that act on the torsion.  If one of them is free, the buffer's torque is an objective by
#: default.
TORSIONAL = ("buffer.k_T", "buffer.k_T3", "buffer.c_T", "buffer.c_T2")
#: A free value that is not a field: the damper as a share of critical damping, which replaces c_A.
DAMPING_RATIO = "damping_ratio"
_DAMPERS = ("buffer.c_A", "buffer.c_A_rebound")
#: Upper end of a damper's range, as a share of critical damping.  Optima have a tenth of it, and
#: the computing time of a run grows with the damper.
_OVERDAMPED = 2.0
#: Factor by which a range is widened, and the least ratio of the ends of a wide range.
_WIDER, _WIDE = 10.0, 100.0
#: Least stroke for the ranges, as a multiple of the penetration of a contact without a buffer.
_OF_CONTACT = 5.0
#: Values that ``buffer.force_table`` replaces.
_OF_AXIAL_SPRING = ("buffer.k_A", "buffer.k_A3", "buffer.preload")
#: Stroke (m) and torsion (rad) for the ranges if no limit is given.
_USUAL_STROKE, _USUAL_TORSION = 0.02, 0.01


def may_widen(variable: Input, end: str) -> bool:
    """Return True if the search may widen the range of a variable at this end.

    It may not widen a range of the user, or the upper end of a damper's range.
    """
    is_damper = variable.name in (*_DAMPERS, DAMPING_RATIO)
    return not (variable.text or (is_damper and end == "upper"))


def widened(variable: Input, end: str) -> Input:
    """Return a variable with one end of its range moved outwards by a factor of ten."""
    if end == "lower":
        return variable.between(variable.low / _WIDER, variable.high)
    return variable.between(variable.low, variable.high * _WIDER)


def make_variables(scene: Scene, limits: Sequence[Limit], free: Sequence[str]) -> tuple[Input, ...]:
    """Return the free values with their ranges or catalogues.

    ``free`` are texts ``NAME``, ``NAME=LOW:HIGH``, ``NAME=[A,B,..]``, ``NAME=LOW:HIGH:COUNT`` or
    ``NAME=VALUE``.  A default range surrounds the value of a buffer that absorbs the energy of the
    approach within the limits of its strokes.
    SceneError if a name or a range is invalid.
    """
    usual = _usual_ranges(scene, limits)
    variables: dict[str, Input] = {}
    for text in free:
        name, _, given = (part.strip() for part in text.partition("="))
        if len(fields := paths.expanded(name)) == 1:
            name = fields[0]
        what = _declaration(scene, name)
        if name in variables:
            raise SceneError(f"free {name}: must be given once")
        if given:
            variable = read_input(scene, name, given, FORMS_OF_DESIGN, what)
            if variable.values:
                variable = _of_catalogue(variable)
            ends = variable.low, variable.high
            is_whole = not variable.values and _is_wide(ends, usual.get(name))
            variable = dataclasses.replace(variable, is_whole=is_whole)
        elif name in usual:
            variable = Input(name, what.unit).between(*usual[name])
            for end in usual[name]:
                accept(end, what, f"free {name}")
        else:
            raise SceneError(f"free {name}: must have a range, {name}=LOW:HIGH, or values")
        variables[name] = variable
    if not variables:
        raise SceneError("free: must have one value or more")
    taken = [path for name in variables for path in paths.expanded(name)]
    if twice := [path for path in taken if taken.count(path) > 1]:
        raise SceneError(f"free {twice[0]}: must be given once")
    if all(len(each.values) == 1 for each in variables.values()):
        held = ", ".join(free)
        raise SceneError(f"free {held}: nothing to search: one must have a range or more values")
    if {DAMPING_RATIO, "buffer.c_A"} <= set(variables):
        raise SceneError(f"free {DAMPING_RATIO}: must be without buffer.c_A, which it gives")
    return tuple(variables.values())


def _of_catalogue(given: Input) -> Input:
    """Return an input whose values are sorted and different."""
    values = tuple(sorted(set(given.values)))
    return dataclasses.replace(given, values=values, low=values[0], high=values[-1])


def _declaration(scene: Scene, name: str) -> Declared:
    if name == DAMPING_RATIO:
        doc = "damper of the axial spring, as a share of the critical one"
        return Declared(name, float, False, True, "1", POSITIVE, (), doc)
    what = declaration_of(scene, name)
    if name in APPROACH or what.kind is not float:
        raise SceneError(f"free {name}: must be a number of the scene")
    if scene.buffer.force_table is not None and name in _OF_AXIAL_SPRING:
        raise SceneError(
            f"free {name}: must not be free with buffer.force_table, which gives the spring"
        )
    return what


def _is_wide(ends: tuple[float, float], usual: tuple[float, float] | None) -> bool:
    """Return True if a given range contains the usual range, or spans two decades."""
    if usual is not None and ends[0] <= usual[0] and usual[1] <= ends[1]:
        return True
    return ends[0] > 0.0 and ends[1] / ends[0] >= _WIDE


def reduced_mass(scene: Scene) -> float:
    """Return the reduced mass of both vehicles, kg."""
    chaser, target = scene.chaser_total_mass, scene.target.mass
    return chaser * target / (chaser + target)


def _usual_ranges(scene: Scene, limits: Sequence[Limit]) -> dict[str, tuple[float, float]]:
    """Return ranges around a buffer that absorbs the approach's energy within its strokes.

    The ranges are (low, high) by name, in SI units.
    """
    given = {limit.key.removesuffix("_before_latch"): limit.value for limit in limits}
    speed = approach_of(scene).speed
    # least stroke: a stiffer buffer would hardly move, because the contact yields instead
    least = _OF_CONTACT * _penetration(scene, speed)
    stroke = max(given.get("max_axial_stroke_in", _USUAL_STROKE), least)
    torsion = given.get("max_torsion", _USUAL_TORSION)
    k_A = reduced_mass(scene) * (speed / stroke) ** 2
    c_A = 2.0 * reduced_mass(scene) * speed / stroke  # critical damping on the spring k_A
    k_T = k_A * stroke * scene.rest_length / torsion
    c_T = k_T * torsion * scene.rest_length / speed
    turning = speed / scene.rest_length
    return {
        "buffer.k_A": (k_A / 50.0, k_A * 20.0),
        "buffer.k_T": (k_T / 100.0, k_T * 100.0),
        "buffer.c_A": (c_A / 300.0, c_A * _OVERDAMPED),
        "buffer.c_A_rebound": (c_A / 300.0, c_A * _OVERDAMPED),
        DAMPING_RATIO: (1.0 / 300.0, _OVERDAMPED),
        "buffer.preload": (0.0, k_A * stroke),
        "buffer.friction": (0.0, k_A * stroke),
        "buffer.k_A3": (0.0, 100.0 * k_A / stroke**2),
        "buffer.c_A2": (0.0, 10.0 * c_A / speed),
        "buffer.c_T": (0.0, 10.0 * c_T),
        "buffer.k_T3": (0.0, 100.0 * k_T / torsion**2),
        "buffer.c_T2": (0.0, 10.0 * c_T / turning),
    }


def _penetration(scene: Scene, speed: float) -> float:
    """Return the penetration if the contact alone absorbed the energy of the approach, m.

    0 if the contact has a measured force curve.
    """
    if scene.contact.force_table is not None:
        return 0.0
    energy, p = 0.5 * reduced_mass(scene) * speed**2, scene.contact.exponent
    return float(((p + 1.0) * energy / scene.contact_stiffness) ** (1.0 / (p + 1.0)))


def with_values(scene: Scene, values: Mapping[str, float]) -> Scene:
    """Return a scene with a candidate's values; see :func:`fields_of`."""
    changed: Scene = paths.with_values(scene, fields_of(scene, values))
    return changed


def fields_of(scene: Scene, values: Mapping[str, float]) -> dict[str, float]:
    """Return the fields of a scene, by name, for a candidate's values.

    The damping ratio is converted to ``buffer.c_A``.  A rebound damper keeps its ratio to the
    damper unless it is itself a free value.
    """
    fields = {name: value for name, value in values.items() if name != DAMPING_RATIO}
    if DAMPING_RATIO in values:
        k_A = fields.get("buffer.k_A", scene.buffer.k_A)
        critical = 2.0 * math.sqrt(k_A * reduced_mass(scene))
        fields["buffer.c_A"] = values[DAMPING_RATIO] * critical
    own, name = scene.buffer, "buffer.c_A_rebound"
    if own.c_A_rebound is not None and own.c_A and name not in fields and "buffer.c_A" in fields:
        fields[name] = own.c_A_rebound / own.c_A * fields["buffer.c_A"]
    return fields


def own_value(scene: Scene, name: str) -> float:
    """Return a free value of the unchanged scene; 0 if the scene has no such value."""
    if name == DAMPING_RATIO:
        critical = 2.0 * math.sqrt(scene.buffer.k_A * reduced_mass(scene))
        return scene.buffer.c_A / critical if critical else 0.0
    return float(paths.get(scene, name) or 0.0)
