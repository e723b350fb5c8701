"""Loading of scenes, with checks of the rules that tie their parts together."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from capture_sim.base.compiled.kernels import plain
from capture_sim.base.resources import config_dir
from capture_sim.errors import SceneError
from capture_sim.scene import paths
from capture_sim.scene.approach import approached
from capture_sim.scene.ball_loads import LOADS, loads
from capture_sim.scene.cache import depends_on
from capture_sim.scene.files import (
    Overrides,
    build,
    find_scene,
    has_overrides,
    known_fields,
    overridden,
    override_items,
    override_texts,
    parse_scene,
    read_scene,
)
from capture_sim.scene.geometry import nearest_on_wall
from capture_sim.scene.launch_plan import (
    RESISTANCE,
    TIP_AT_RELEASE,
    LaunchPlan,
    plan_launch,
    pull_along,
    tip_at_release,
    travel_to_touch,
)
from capture_sim.scene.laws import NEED_POSITIVE_RESTITUTION
from capture_sim.scene.parts import HERTZ, Scene, as_mapping, as_name
from capture_sim.scene.quantities import Checked, declared, refuse, replaced, shown

#: Between a scene's title and the list of its changes.
_CHANGED = "; with "
#: Between two changes; a value may have commas.
_NEXT_CHANGE = re.compile(r", (?=[a-z_]\w*(?:\.\w+)*=)")
#: Smallest distance of two strokes, or depths of a contact, in a table of forces, m.
MIN_TABLE_SPACING, MIN_DEPTH_SPACING = 1e-6, 1e-9
#: Share of the tip's radius: a deeper penetration stops the run.
MAX_DEPTH_SHARE = 0.75
#: Longest step of rk4 on the steepest part of a contact, rad of its oscillation.
MAX_FIXED_ANGLE = 1.5
#: A name that lists more changes than fit gets a hash of them, characters.
_LONGEST_NAME = 60


def load_scene(name_or_path: str | Path, overrides: Overrides = ()) -> Scene:
    """Load a scene by name (config/scenes) or path, and change values in it.

    Parameters
    ----------
    name_or_path
        Name, e.g. ``"tilt_p10"``, or path of a YAML file.
    overrides
        Changed values as texts, e.g. ``["buffer.c_A=13"]``, or by name, e.g.
        ``{"buffer.c_A": 13}`` or a row of a pandas table; SI units, or texts with a unit.
        ``approach.angle``, ``.offset`` or ``.mouth_offset``, and ``.speed`` start the scene just
        before its first touch, without rail and string.

    Returns
    -------
    Scene
        The checked scene, frozen; its parts and their fields are those of the YAML file, e.g.
        ``scene.buffer.c_A``.

    Raises
    ------
    SceneError
        The scene is not found or a value is invalid; the message names field, value, unit and
        allowed range in one line.

    See Also
    --------
    capture_sim.scene_names : Names of the packaged scenes.
    capture_sim.simulate : Loads and runs a scene in one call.

    Examples
    --------
    >>> from capture_sim import load_scene
    >>> scene = load_scene("tilt_p10", {"buffer.c_A": "20 N s/m"})
    >>> scene.title, scene.buffer.c_A
    ('Ground bench, target turned by +10 degrees; with buffer.c_A=20 N s/m', 20.0)
    >>> load_scene("tilt_p10", {"buffer.c_A": -1})
    Traceback (most recent call last):
    capture_sim.errors.SceneError: buffer.c_A = -1 N s/m: must be >= 0
    """
    kept = _packaged.get(name_or_path) if isinstance(name_or_path, str) else None
    if kept is not None and kept.is_current():
        return change_scene(kept.scene, overrides) if has_overrides(overrides) else kept.scene
    path = find_scene(name_or_path)
    files: list[Path] = []
    data = read_scene(path, files)
    data.setdefault("name", path.stem)
    data.setdefault("title", str(data["name"]))
    if path.parent != config_dir() / "scenes":
        # a user's file: name it in the error, before its values are changed
        try:
            check_scene(build(data))
        except SceneError as error:
            raise SceneError(f"{path.name}: {error}") from None
    elif isinstance(name_or_path, str):
        _keep(name_or_path, files, data)
    return _changed(data, override_items(overrides))


class _Packaged(NamedTuple):
    """A scene that comes with the package, and the files that it was read from."""

    scene: Scene
    files: list[tuple[Path, tuple[int, ...]]]  # with the state of each

    def is_current(self) -> bool:
        """Return True if each file is as it was when the scene was read."""
        return all(_state_of(path) == state for path, state in self.files)


#: Packaged scenes by name: reading one takes half as long as its run.
_packaged: dict[str, _Packaged] = {}
#: Age from which a file's state tells its contents: the clock of a file system has steps, s.
_SETTLED = 2.0


def _state_of(path: Path) -> tuple[int, ...]:
    try:
        found = os.stat(path)  # noqa: PTH116
    except OSError:
        return ()
    return found.st_mtime_ns, found.st_ctime_ns, found.st_size, found.st_ino


def _keep(name: str, files: Sequence[Path], data: dict[str, object]) -> None:
    states = [(path, _state_of(path)) for path in files]
    settled = (time.time() - _SETTLED) * 1e9
    if all(state and max(state[:2]) < settled for _, state in states):
        with suppress(SceneError):  # the overrides may complete it
            _packaged[name] = _Packaged(_changed(data, []), states)


def load_requested(text: str, overrides: Overrides = (), folder: Path | None = None) -> Scene:
    """Load a scene that is requested over the network, with overrides as :func:`load_scene`.

    ``text`` is YAML text if it contains a line break; otherwise it is the name of a file in
    ``folder``, if given, or of a packaged scene.  SceneError if it is a path, because a request
    must not read any other file of this machine, or if the scene is not found or is invalid.
    """
    if "\n" in text:
        return load_scene_text(text, overrides)
    name = text.removesuffix(".yaml")
    if "/" in name or name.endswith((".yaml", ".yml")):
        raise SceneError(f"scene = {shown(text)}: must be a packaged scene's name, or YAML text")
    return load_scene(find_scene(name, folder), overrides)


def load_scene_text(text: str, overrides: Overrides = (), *, only_known: bool = False) -> Scene:
    """Return the checked scene of complete YAML text, as recordings contain it.

    The text must not contain ``extends``, and gives the scene's name and title.  ``only_known``
    ignores fields that this version does not know, which are otherwise mistakes.  ``overrides``
    and errors are those of :func:`load_scene`.
    """
    data = parse_scene(text, "scene")
    items = override_items(overrides)
    return _changed(known_fields(data) if only_known else data, items)


def as_scene(scene: Scene | str | Path, overrides: Overrides = ()) -> Scene:
    """Return a scene that is given by itself, its name or its file, with changed values.

    ``overrides`` and errors are those of :func:`load_scene`.
    """
    if not isinstance(scene, Scene):
        return load_scene(scene, overrides)
    return change_scene(scene, overrides) if has_overrides(overrides) else scene


def change_scene(scene: Scene, overrides: Overrides) -> Scene:
    """Return a checked scene with changed values, which its title then lists.

    ``overrides`` and errors are those of :func:`load_scene`.
    """
    items = override_items(overrides)
    if all(_is_value(scene, name) for name, _ in items):
        with suppress(SceneError):  # refused again below, with all wrong values by their names
            return _finished(paths.with_values(scene, dict(items)), items)
    return _changed(as_mapping(scene), items)


def _is_value(scene: Scene, name: str) -> bool:
    """Return True if ``name`` is the dotted name of a value, not of a part, that the scene has."""
    *owners, last = name.split(".")
    part: Any = scene
    for owner in owners:
        part = part.__dict__.get(owner) if owner in declared(type(part)) else None
        if not isinstance(part, Checked):
            return False
    spec = declared(type(part)).get(last)
    return spec is not None and not issubclass(spec.kind, Checked)


def _changed(data: dict[str, object], items: Sequence[tuple[str, Any]]) -> Scene:
    """Build a scene from nested values with overrides, which its title lists, and check it.

    The fields of ``approach`` start the scene just before its first touch.
    """
    data = overridden(data, items)
    approach = data.pop("approach", None)
    scene: Scene = build(data)
    if approach is not None:
        if not isinstance(approach, Mapping):
            raise SceneError("approach: must be its fields, e.g. approach.angle='5 deg'")
        scene = approached(scene, approach)
    return _finished(scene, items)


def _finished(scene: Scene, items: Sequence[tuple[str, Any]]) -> Scene:
    """Return a changed scene with the changes added to its title; SceneError if it is invalid."""
    texts = [text for text in override_texts(items) if not text.startswith("title=")]
    if texts:
        scene = replaced(scene, {"title": f"{scene.title}{_CHANGED}{', '.join(texts)}"})
    check_scene(scene)
    return scene


def overrides_of(scene: Scene) -> list[str]:
    """Return the changes that a scene's title lists, each as ``name=value``.

    A value that the title abbreviates is given in full; a changed title is not listed.
    """
    _, _, changes = scene.title.partition(_CHANGED)
    texts = _NEXT_CHANGE.split(changes.replace(_CHANGED, ", ")) if changes else []
    return [_in_full(scene, text) for text in texts]


def _in_full(scene: Scene, change: str) -> str:
    name, _, text = change.partition("=")
    value = paths.get(scene, name)
    is_long = "..." in text and isinstance(value, tuple | Checked)
    return f"{name}={json.dumps(as_mapping(value))}" if is_long else change


def overridden_name(scene: Scene) -> str:
    """Return a name for a changed scene that contains its changes, e.g. ``tilt_0_c_A_20``.

    A name of more than 60 characters has a hash of the changes instead.  A scene without changes,
    or whose name was changed, keeps its name.
    """
    changes = overrides_of(scene)
    if any(change.startswith("name=") for change in changes):
        return scene.name
    fields = (change.partition("=") for change in changes)
    texts = [f"{path.rpartition('.')[2]}_{value}" for path, _, value in fields]
    name = "_".join([scene.name, *texts])
    if len(name) > _LONGEST_NAME:
        digest = hashlib.sha256(", ".join(changes).encode()).hexdigest()[:8]
        name = f"{scene.name}_{digest}"
    return as_name(name)


def check_scene(scene: Scene) -> LaunchPlan:
    """Check the rules between several fields or parts of a scene, and return its launch plan.

    SceneError names the first rule that the scene breaks.  The scene object that passed the last
    check, e.g. in :func:`change_scene` before its run, is not checked again.
    """
    global _checked
    last = _checked
    if last is None or last[0] is not scene:
        last = _checked = scene, _plan_of(scene)
    return last[1]


#: The scene that was checked last, and its plan.
_checked: tuple[Scene, LaunchPlan] | None = None


def _plan_of(scene: Scene) -> LaunchPlan:
    rules = (
        *(_contact, _contact_table, _friction, _throat, _force_table, _stops, _rates),
        *(_start, _supports, _rail, _string, _latch, _thrusters),
    )
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused by name
            for rule in rules:
                rule(scene)
            return plan_launch(scene)
    except ArithmeticError:
        raise SceneError(
            f"{scene.name}: its values differ too much in size to be computed with"
        ) from None


@depends_on("contact")
def _contact(scene: Scene) -> None:
    law, restitution = scene.contact.law, scene.contact.restitution
    is_given = scene.contact.hysteresis_factor is not None
    if not is_given and law in NEED_POSITIVE_RESTITUTION and restitution <= 0.0:
        raise refuse("contact.restitution", restitution, "", f"> 0 and <= 1 with the law {law}")
    stiffness, exponent = scene.contact.stiffness, scene.contact.exponent
    if scene.contact.force_table is not None:
        if stiffness is not None:
            raise refuse("contact.stiffness", stiffness, "N/m^p", "null with contact.force_table")
        if exponent != HERTZ:
            raise refuse("contact.exponent", exponent, "", "1.5 with contact.force_table")
    elif stiffness is None and exponent != HERTZ:
        why = "eq. (2) is for a sphere on a plane"
        raise refuse("contact.exponent", exponent, "", f"1.5 without contact.stiffness: {why}")


@depends_on("contact", "probe", "run")
def _contact_table(scene: Scene) -> None:
    table, run, mass = scene.contact.force_table, scene.run, scene.probe.mass
    if table is None:
        return
    name, R_t = "contact.force_table", scene.probe.tip_radius
    _check_table(name, "depth", table, MIN_DEPTH_SPACING)
    forces = [force for _, force in table]
    if forces[0] > 0.0:
        why = "a force cannot jump; give it a ramp, e.g. [[0, 0], [10 um, 5 N], ...]"
        raise refuse(f"{name}[0], force", forces[0], "N", f"0: {why}")
    for k in range(1, len(table)):
        if forces[k] < forces[k - 1]:
            allowed = f">= {forces[k - 1]:.9g}, the force of the point before"
            raise refuse(f"{name}[{k}], force", forces[k], "N", allowed)
    last = len(table) - 1
    if forces[last] <= 0.0:
        allowed = "> 0, the force at depth 0: the wall has no stiffness"
        raise refuse(f"{name}[{last}], force", forces[last], "N", allowed)
    limit = MAX_DEPTH_SHARE * R_t
    if table[last][0] > limit:
        why = "3/4 of the tip's radius, where a run stops"
        raise refuse(f"{name}[{last}], depth", table[last][0], "m", f"<= {limit:.6g}, {why}")
    if run.method == "rk4":
        steepest = max(
            (high[1] - low[1]) / (high[0] - low[0])
            for low, high in itertools.pairwise(table)
            if high[0] > low[0]
        )
        longest = MAX_FIXED_ANGLE * math.sqrt(mass / steepest)
        if run.step > longest:
            why = "for the steepest part of contact.force_table"
            raise refuse("run.step", run.step, "s", f"<= {longest:.3g} {why}")


@depends_on("friction")
def _friction(scene: Scene) -> None:
    mu, mu_s = scene.friction.mu, scene.friction.mu_s
    if mu_s is not None and mu_s < mu:
        raise refuse("friction.mu_s", mu_s, "", f">= {mu:g}, friction.mu, or null")


@depends_on("cone", "probe", "buffer.rest_length")
def _throat(scene: Scene) -> None:
    R_c, R_t, rest_length = scene.cone.R_c, scene.probe.tip_radius, scene.buffer.rest_length
    if R_c < R_t:
        why = "the radius of the tip, or the tip can never come to BE"
        raise refuse("cone.R_c", R_c, "m", f">= {R_t:g}, {why}")
    if rest_length is not None and rest_length <= R_t:
        raise refuse("buffer.rest_length", rest_length, "m", f"> {R_t:g}, the radius of the tip")


@depends_on("buffer")
def _force_table(scene: Scene) -> None:
    buffer, table = scene.buffer, scene.buffer.force_table
    if table is None:
        return
    for name, unit in (("k_A", "N/m"), ("k_A3", "N/m^3"), ("preload", "N")):
        value = getattr(buffer, name)
        if value != 0.0:
            raise refuse(f"buffer.{name}", value, unit, "0 with buffer.force_table")
    _check_table("buffer.force_table", "stroke", table, MIN_TABLE_SPACING)


def _check_table(
    name: str, place: str, table: tuple[tuple[float, float], ...], spacing: float
) -> None:
    """Check a table of measured forces; SceneError if it breaks a rule.

    The strokes or depths (``place`` is ``"stroke"`` or ``"depth"``) rise from 0 by at least
    ``spacing`` (m), and no force is negative.  A point may be listed twice, as a kink of the
    curve, if there are other points on both sides of it.
    """
    places, forces = zip(*table, strict=True)
    if places[0] != 0.0:
        why = "0, the rest length" if place == "stroke" else "0, the start of a touch"
        raise refuse(f"{name}[0], {place}", places[0], "m", why)
    last = len(table) - 1
    for k in range(1, len(table)):
        is_kink = table[k] == table[k - 1] and 1 < k < last and places[k] > places[k - 2]
        low = places[k - 1] + spacing
        if not (places[k] >= low or is_kink):
            why = "in rising order, or the point before once more as a kink between two others"
            raise refuse(f"{name}[{k}], {place}", places[k], "m", f">= {low:.9g}, {why}")
    for k, force in enumerate(forces):
        if force < 0.0:
            raise refuse(f"{name}[{k}], force", force, "N", ">= 0")


@depends_on("stops", "buffer.preload", "buffer.force_table")
def _stops(scene: Scene) -> None:
    stops, preload = scene.stops, scene.buffer.seat_force
    if stops is not None and stops.extension is not None and preload > 0.0:
        field = "preload" if scene.buffer.force_table is None else "force_table[0], force"
        why = f"null with buffer.{field} = {preload:g} N, whose seat is the stop outwards"
        raise refuse("stops.extension", stops.extension, "m", why)


@depends_on("run", "sensors")
def _rates(scene: Scene) -> None:
    state_rate, sensors = scene.run.state_rate, scene.sensors
    rates = {"run.rate": scene.run.rate}
    for name in ("motion_capture", "load_cell"):
        sensor = getattr(sensors, name, None)
        if sensor is not None:
            rates[f"sensors.{name}.rate"] = sensor.rate
    for name, rate in rates.items():
        ratio = state_rate / rate
        if ratio < 1.0 or abs(ratio - round(ratio)) > 1e-9 * ratio:
            allowed = f"run.state_rate ({state_rate:g} Hz) divided by a whole number"
            raise refuse(name, rate, "Hz", allowed)


@depends_on(*LOADS, "supports")
def _supports(scene: Scene) -> None:
    if scene.supports is None:
        return
    for vehicle in ("chaser", "target"):
        balls = [list(ball) for ball in getattr(scene.supports, vehicle).balls]
        try:
            load = loads(scene, vehicle).tolist()
        except np.linalg.LinAlgError:
            load = [math.nan]
        allowed = ""
        if not all(abs(force) <= 1e6 * scene.gravity * 1e3 for force in load):  # NaN is not
            allowed = "three points that do not lie in one line"
        elif min(load) < 0.0:
            allowed = (
                "a triangle around the centre of mass; with these, ball "
                f"{load.index(min(load))} would lift off"
            )
        if allowed:
            raise refuse(f"supports.{vehicle}.balls", balls, "m", allowed)


@depends_on(*TIP_AT_RELEASE, "initial", "cone", "rail", *RESISTANCE)
def _rail(scene: Scene) -> None:
    if scene.rail is None:
        return
    chaser, target = scene.initial.chaser, scene.initial.target
    along = chaser.vx * math.cos(chaser.theta) + chaser.vy * math.sin(chaser.theta)
    across = chaser.vy * math.cos(chaser.theta) - chaser.vx * math.sin(chaser.theta)
    if chaser.omega != 0.0:
        raise refuse("initial.chaser.omega", chaser.omega, "rad/s", "0 on the rail")
    if abs(across) > 1e-12 * max(1.0, abs(along)) or along < 0.0:
        raise SceneError(
            f"initial.chaser.vx, vy = {chaser.vx!r}, {chaser.vy!r} m/s: must be, on the rail, a "
            "velocity along the chaser's heading, forwards"
        )
    for name, unit in (("vx", "m/s"), ("vy", "m/s"), ("omega", "rad/s")):
        value = getattr(target, name)
        if value != 0.0:
            raise refuse(f"initial.target.{name}", value, unit, "0 while the scene has a rail")
    limit, along = 0.0, pull_along(scene)
    if scene.supports is not None:
        limit = scene.supports.chaser.c_rr * scene.gravity * scene.chaser_total_mass
    if abs(along) > limit:
        floor, body = scene.floor, scene.chaser
        raise SceneError(
            f"floor.tilt_x, tilt_y = {floor.tilt_x!r}, {floor.tilt_y!r} rad, chaser.cable_x, "
            f"cable_y = {body.cable_x!r}, {body.cable_y!r} N: pull with {abs(along):.6g} N along "
            f"the rail: must be <= {limit:.6g}, where the chaser rolls by itself"
        )
    travel, length = travel_to_touch(scene), scene.rail.length
    if length >= travel:
        why = "where the tip meets the cone: the rail must end before the contact"
        raise refuse("rail.length", length, "m", f"< {travel:.6g}, {why}")


@depends_on("string", "rail", "initial")
def _string(scene: Scene) -> None:
    string = scene.string
    if string is None:
        return
    if scene.rail is None:
        raise SceneError("string: must be null without a rail to guide the chaser")
    names = ("impact_speed", "hanging_mass", "drop_height")
    given = [name for name in names if getattr(string, name) is not None]
    if len(given) != 2:
        raise SceneError(
            f"string: {', '.join(given) if given else 'nothing'} given: must be exactly two of "
            "impact_speed (m/s), hanging_mass (kg), drop_height (m); the third is null and follows"
        )
    start = math.hypot(scene.initial.chaser.vx, scene.initial.chaser.vy)
    if start != 0.0:
        raise SceneError(
            f"initial.chaser.vx, vy: speed {start!r} m/s: must be 0 with a string: the mass "
            "starts from rest, and the string would be slack"
        )


@depends_on("cone", "latch")
def _latch(scene: Scene) -> None:
    mouth = scene.cone.L_c * math.cos(scene.cone.half_angle)
    if scene.latch is not None and scene.latch.radius >= mouth:
        raise refuse("latch.radius", scene.latch.radius, "m", f"< {mouth:.6g}, the cone's depth")


@depends_on("thrusters")
def _thrusters(scene: Scene) -> None:
    thrusters = scene.thrusters
    if thrusters is not None and thrusters.chaser is None and thrusters.target is None:
        raise SceneError("thrusters: must be on the chaser or the target, or null")


@depends_on(*TIP_AT_RELEASE, "cone")
def _start(scene: Scene) -> None:
    px, py, _, _ = tip_at_release(scene)
    cone, initial = scene.cone, scene.initial
    for side, name in ((1.0, "+y"), (-1.0, "-y")):
        distance, _, _ = plain(nearest_on_wall)(-(px + cone.L_T), side * py, *cone.wall)
        gap = distance - scene.probe.tip_radius
        # a start at contact: the places' own rounding
        if gap < -1e-15 * max(1.0, abs(initial.chaser.x), abs(initial.target.x)):
            raise SceneError(
                f"initial: the tip starts {-gap:.6g} m inside the cone's {name} wall: must be a "
                "gap >= 0 m; move initial.target.x or initial.chaser.x"
            )
