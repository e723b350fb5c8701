"""Scenes ready to be launched: loaded, and checked for what ties their parts together."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from capture_sim.errors import SceneError
from capture_sim.kernels import plain
from capture_sim.launch.plan import LaunchPlan, plan_launch, tip_at_release, travel_to_touch
from capture_sim.model.contact import NEED_POSITIVE_RESTITUTION
from capture_sim.model.geometry import nearest_on_wall
from capture_sim.model.parameters import loads
from capture_sim.resources import config_dir
from capture_sim.scene.files import (
    Overrides,
    build,
    find_scene,
    overridden,
    parse_scene,
    read_scene,
)
from capture_sim.scene.parts import Scene, as_mapping
from capture_sim.scene.paths import with_current_names


def load_scene(name_or_path: str | Path, overrides: Overrides = ()) -> Scene:
    """Load a scene by name (config/scenes) or path, with values overridden.

    Parameters
    ----------
    name_or_path
        ``"tilt_p10"``, or the path of a YAML file.
    overrides
        ``"part.field=value"`` items, as ``"buffer.c_A=13"``, or values by such names, as
        ``{"buffer.c_A": 13}``; SI units.

    Raises
    ------
    SceneError
        One line that names the field, the value, the unit and the allowed range.
    """
    path = find_scene(name_or_path)
    data = read_scene(path)
    data.setdefault("name", path.stem)
    data.setdefault("title", str(data["name"]))
    if path.parent != config_dir() / "scenes":
        # a file of the user's own: say that it is this one, before its values are changed
        try:
            check_scene(build(data))
        except SceneError as error:
            raise SceneError(f"{path.name}: {error}") from None
    return _changed(data, overrides)


def load_scene_text(text: str, overrides: Overrides = ()) -> Scene:
    """Make a scene of resolved YAML text (no ``extends``), as recordings hold it.

    See :func:`load_scene`.  Names that fields had before are read without a word.
    """
    return _changed(with_current_names(parse_scene(text, "scene")), overrides)


def change_scene(scene: Scene, overrides: Overrides) -> Scene:
    """Return a scene with values overridden; see :func:`load_scene`."""
    return _changed(as_mapping(scene), overrides)


def _changed(data: dict[str, object], overrides: Overrides) -> Scene:
    """Make a checked scene with values changed; its title says which."""
    data, changes = overridden(data, overrides)
    scene: Scene = build(data)
    if changes and not any(change.startswith("title=") for change in changes):
        scene = dataclasses.replace(scene, title=f"{scene.title}; with {', '.join(changes)}")
    check_scene(scene)
    return scene


def check_scene(scene: Scene) -> LaunchPlan:
    """Check what ties the parts of a scene together; return how it is launched.

    Raises
    ------
    SceneError
        For the first rule that the scene breaks.
    """
    rules = (_contact, _friction, _throat, _rates, _start, _supports, _rail, _string, _latch)
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused by name
            for rule in rules:
                rule(scene)
            return plan_launch(scene)
    except ArithmeticError:
        raise SceneError(
            f"{scene.name}: its values differ too much in size to be computed with"
        ) from None


def _contact(scene: Scene) -> None:
    if scene.contact.law in NEED_POSITIVE_RESTITUTION and scene.contact.restitution <= 0.0:
        raise SceneError(
            f"contact.restitution = {scene.contact.restitution!r}: allowed is > 0 and <= 1 "
            f"with the law {scene.contact.law}"
        )


def _friction(scene: Scene) -> None:
    mu_s = scene.friction.mu_s
    if mu_s is not None and mu_s < scene.friction.mu:
        raise SceneError(
            f"friction.mu_s = {mu_s!r}: allowed is >= {scene.friction.mu:g}, friction.mu, or null"
        )


def _throat(scene: Scene) -> None:
    if scene.cone.R_c < scene.probe.tip_radius:
        raise SceneError(
            f"cone.R_c = {scene.cone.R_c!r} m: allowed is >= {scene.probe.tip_radius:g}, the "
            "radius of the tip, or the tip can never come to BE"
        )
    if scene.buffer.rest_length is not None and scene.buffer.rest_length <= scene.probe.tip_radius:
        raise SceneError(
            f"buffer.rest_length = {scene.buffer.rest_length!r} m: allowed is > "
            f"{scene.probe.tip_radius:g}, the radius of the tip"
        )


def _rates(scene: Scene) -> None:
    ratio = scene.run.state_rate / scene.run.rate
    if ratio < 1.0 or ratio != round(ratio):
        raise SceneError(
            f"run.rate = {scene.run.rate!r} Hz: allowed is run.state_rate "
            f"({scene.run.state_rate:g} Hz) divided by a whole number"
        )
    for name in ("motion_capture", "load_cell"):
        sensor = None if scene.sensors is None else getattr(scene.sensors, name)
        if sensor is not None:
            ratio = scene.run.state_rate / sensor.rate
            if ratio < 1.0 or abs(ratio - round(ratio)) > 1e-9 * ratio:
                raise SceneError(
                    f"sensors.{name}.rate = {sensor.rate!r} Hz: allowed is run.state_rate "
                    f"({scene.run.state_rate:g} Hz) divided by a whole number"
                )


def _supports(scene: Scene) -> None:
    if scene.supports is None:
        return
    for vehicle in ("chaser", "target"):
        balls = getattr(scene.supports, vehicle).balls
        try:
            load = loads(scene, vehicle)
        except np.linalg.LinAlgError:
            load = np.array([math.nan])
        if not np.all(np.isfinite(load)) or np.abs(load).max() > 1e6 * scene.gravity * 1e3:
            raise SceneError(
                f"supports.{vehicle}.balls = {[list(b) for b in balls]} m: allowed is three "
                "points that do not lie in one line"
            )
        if load.min() < 0.0:
            raise SceneError(
                f"supports.{vehicle}.balls = {[list(b) for b in balls]} m: allowed is a triangle "
                f"round the centre of mass; as it is, ball {int(load.argmin())} would lift off"
            )


def _rail(scene: Scene) -> None:
    if scene.rail is None:
        return
    chaser, target = scene.initial.chaser, scene.initial.target
    along = chaser.vx * math.cos(chaser.theta) + chaser.vy * math.sin(chaser.theta)
    across = chaser.vy * math.cos(chaser.theta) - chaser.vx * math.sin(chaser.theta)
    if chaser.omega != 0.0:
        raise SceneError(f"initial.chaser.omega = {chaser.omega!r} rad/s: allowed is 0 on the rail")
    if abs(across) > 1e-12 * max(1.0, abs(along)) or along < 0.0:
        raise SceneError(
            f"initial.chaser.vx, vy = {chaser.vx!r}, {chaser.vy!r} m/s: allowed on the rail is a "
            "velocity along the chaser's heading, forwards"
        )
    for name in ("vx", "vy", "omega"):
        value = getattr(target, name)
        if value != 0.0:
            unit = "rad/s" if name == "omega" else "m/s"
            raise SceneError(
                f"initial.target.{name} = {value!r} {unit}: allowed is 0 while the scene has a rail"
            )
    travel = travel_to_touch(scene)
    if scene.rail.length >= travel:
        raise SceneError(
            f"rail.length = {scene.rail.length!r} m: allowed is < {travel:.6g}, where the tip "
            "meets the cone: the rail must end before the contact"
        )


def _string(scene: Scene) -> None:
    string = scene.string
    if string is None:
        return
    if scene.rail is None:
        raise SceneError("string: allowed only with a rail to guide the chaser; rail is null")
    given = [
        name
        for name in ("impact_speed", "hanging_mass", "drop_height")
        if getattr(string, name) is not None
    ]
    if len(given) != 2:
        raise SceneError(
            f"string: {', '.join(given) if given else 'nothing'} given: allowed are exactly two of "
            "impact_speed (m/s), hanging_mass (kg), drop_height (m); the third is null and follows"
        )
    if string.drop_height is not None and string.drop_height > scene.rail.length:
        raise SceneError(
            f"string.drop_height = {string.drop_height!r} m: allowed is <= "
            f"{scene.rail.length:g}, rail.length: the mass must land before the rail ends"
        )
    start = math.hypot(scene.initial.chaser.vx, scene.initial.chaser.vy)
    if start != 0.0:
        raise SceneError(
            f"initial.chaser.vx, vy: speed {start!r} m/s: allowed is 0 with a string: the mass "
            "starts from rest, and the string would be slack"
        )


def _latch(scene: Scene) -> None:
    if scene.latch is None:
        return
    mouth = scene.cone.L_c * math.cos(scene.cone.half_angle)
    if scene.latch.radius >= mouth:
        raise SceneError(
            f"latch.radius = {scene.latch.radius!r} m: allowed is < {mouth:.6g}, the cone's depth"
        )


def _start(scene: Scene) -> None:
    px, py, _, _ = tip_at_release(scene)
    cone, initial = scene.cone, scene.initial
    for side, name in ((1.0, "+y"), (-1.0, "-y")):
        distance, _, _ = plain(nearest_on_wall)(
            -(px + cone.L_T),
            side * py,
            cone.R_c,
            cone.L_c,
            math.cos(cone.half_angle),
            math.sin(cone.half_angle),
        )
        gap = distance - scene.probe.tip_radius
        # a start at contact: the places' own rounding
        if gap < -1e-15 * max(1.0, abs(initial.chaser.x), abs(initial.target.x)):
            raise SceneError(
                f"initial: the tip starts {-gap:.6g} m inside the cone's {name} wall: allowed is a "
                "gap >= 0 m; move initial.target.x or initial.chaser.x"
            )
