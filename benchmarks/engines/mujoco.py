"""The paper's scene in MuJoCo, as near as its contact can be brought.

MuJoCo's contact is linear, its damping viscous and its friction a softened Coulomb law, so a
Hertz contact can be matched in one bounce only: stiffness and damping (negative ``solref``)
are fitted to duration and momentum of the reference's first bounce, and the softness of the
friction to its whole course, which flatters it.  The walls are boxes with their faces where
the cone's are.
"""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.engines import bounce
from benchmarks.trial import Outcome, Trial
from capture_sim.scene.parts import Scene

NAME = "MuJoCo"
MODULE = "mujoco"
PACKAGE = "mujoco"
REFERENCE = ""
NOTE = "RK4 with fixed steps; linear contact, fitted to the first bounce"
#: How fast friction brings slip to rest within its cone, 1/s; of 1e3 to 1e6 the one with the
#: smallest position error at 0.35 s.
_SLIP_DAMPING = 8e3
_THICKNESS = 0.01  # m, half that of a wall, behind its face


def trials(scene: Scene, quick: bool) -> Iterator[Trial]:
    """Yield the settings to try."""
    solref = functools.cache(functools.partial(fitted_solref, scene))
    for step in (5e-5,) if quick else (1e-3, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5):
        job = functools.partial(prepare, scene, step, "RK4", solref)
        yield Trial(f"{NAME}, fitted", f"step {step:g} s", job, "engine")
    if not quick:
        job = functools.partial(prepare, scene, 2e-3, "Euler", lambda: None)
        yield Trial(f"{NAME}, default settings", "step 0.002 s", job, "engine")


def prepare(
    scene: Scene, step: float, integrator: str, solref: Callable[[], tuple[float, float] | None]
) -> Callable[[], Callable[[], Outcome]]:
    """Build the model; return what runs it and returns what reads the outcome."""
    mujoco = importlib.import_module(MODULE)
    model = build(scene, step, integrator, solref())
    data = at_release(scene, model)
    steps = round(scene.run.t_end / step)

    def run() -> Callable[[], Outcome]:
        mujoco.mj_step(model, data, nstep=steps)

        def read() -> Outcome:
            q = coordinates(scene, data)
            if not (np.isfinite(q).all() and np.abs(q).max() < 10.0):
                return Outcome(np.full(8, np.nan), 0, failure="blew up")
            evaluations = steps * (4 if integrator == "RK4" else 1)
            return Outcome(q, evaluations, peak_force=_peak_force(scene, model))

        return read

    return run


def build(scene: Scene, step: float, integrator: str, solref: tuple[float, float] | None) -> Any:
    """Return the model; joints are x, y, theta_S, theta_P - theta_S, h - h_0, x_T, y_T, theta_T."""
    mujoco = importlib.import_module(MODULE)
    b, cone, probe = scene.buffer, scene.cone, scene.probe
    friction = scene.friction.mu if scene.friction.law != "none" else 0.0
    fitted = ""
    if solref is not None:
        fitted = (
            f'solref="{-solref[0]!r} {-solref[1]!r}" solimp="0.999 0.999 0.001" '
            f'solreffriction="-1 {-_SLIP_DAMPING!r}"'
        )

    def inertial(mass: float, inertia: float, x: float = 0.0) -> str:
        return (
            f'<inertial pos="{x!r} 0 0" mass="{mass!r}" '
            f'diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>'
        )

    def planar(name: str) -> str:
        return "".join(
            f'<joint name="{name}_{axis}" type="{kind}" axis="{vector}"/>'
            for axis, kind, vector in (
                ("x", "slide", "1 0 0"),
                ("y", "slide", "0 1 0"),
                ("theta", "hinge", "0 0 1"),
            )
        )

    walls = ""
    pairs = ""
    for name, side in (("plus", 1.0), ("minus", -1.0)):
        # the face's middle, and the box's centre behind it
        middle_x = -cone.L_T - 0.5 * cone.L_c * math.cos(cone.half_angle)
        middle_y = side * (cone.R_c + 0.5 * cone.L_c * math.sin(cone.half_angle))
        x = middle_x + _THICKNESS * math.sin(cone.half_angle)
        y = middle_y + side * _THICKNESS * math.cos(cone.half_angle)
        walls += (
            f'<geom name="{name}" type="box" size="{0.5 * cone.L_c!r} {_THICKNESS!r} 0.1" '
            f'pos="{x!r} {y!r} 0" axisangle="0 0 1 {-side * cone.half_angle!r}"/>'
        )
        pairs += (
            f'<pair geom1="tip" geom2="{name}" condim="3" '
            f'friction="{friction!r} {friction!r} 0 0 0" {fitted}/>'
        )
    text = f"""
<mujoco>
  <compiler angle="radian" autolimits="false"/>
  <option timestep="{step!r}" integrator="{integrator}" gravity="0 0 0" cone="elliptic"
          tolerance="1e-14" iterations="100"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="chaser">
      {planar("chaser")} {inertial(scene.chaser.mass, scene.chaser.inertia)}
      <body name="cylinder" pos="{b.hinge_offset!r} 0 0">
        <joint type="hinge" axis="0 0 1" stiffness="{b.k_T!r}" damping="{b.c_T!r}"/>
        {inertial(scene.cylinder.mass, scene.cylinder.inertia, -0.5 * scene.cylinder.length)}
        <body name="probe" pos="{scene.rest_length!r} 0 0">
          <joint type="slide" axis="1 0 0" stiffness="{b.k_A!r}" damping="{b.c_A!r}"/>
          {inertial(probe.mass, probe.inertia, -probe.com_offset)}
          <geom name="tip" type="sphere" size="{probe.tip_radius!r}"/>
        </body>
      </body>
    </body>
    <body name="target">
      {planar("target")} {inertial(scene.target.mass, scene.target.inertia)}
      {walls}
    </body>
  </worldbody>
  <contact>{pairs}</contact>
</mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


def at_release(scene: Scene, model: Any) -> Any:
    """Return the model's data in the scene's initial state."""
    mujoco = importlib.import_module(MODULE)
    data = mujoco.MjData(model)
    q, v = scene.initial_coordinates()
    data.qpos[:] = [q[0], q[1], q[2], q[3] - q[2], q[4] - scene.rest_length, *q[5:]]
    data.qvel[:] = [v[0], v[1], v[2], v[3] - v[2], v[4], *v[5:]]
    return data


def coordinates(scene: Scene, data: Any) -> np.ndarray:
    """Return q (8,) in our own coordinates."""
    p = data.qpos
    return np.array([p[0], p[1], p[2], p[2] + p[3], p[4] + scene.rest_length, *p[5:8]])


def fitted_solref(scene: Scene) -> tuple[float, float]:
    """Return stiffness and damping that make the first bounce come out right, frictionless."""
    scene = replace(scene, friction=replace(scene.friction, law="none"))
    step = 2e-6
    end = bounce.first_bounce(scene).start + 2e-3

    def bounce_of(stiffness: float, damping: float) -> tuple[float, np.ndarray]:
        mujoco = importlib.import_module(MODULE)
        model = build(scene, step, "RK4", (stiffness, damping))
        data = at_release(scene, model)
        touching = 0
        for _ in range(round(end / step)):
            mujoco.mj_step(model, data)
            if data.ncon:
                touching += 1
            elif touching:
                break
        return touching * step, np.array(data.qvel[5:7])

    return bounce.fit(scene, (2e7, 2e3), bounce_of)


def _peak_force(scene: Scene, model: Any) -> float:
    """Return the largest normal force, N, looked at after each step."""
    mujoco = importlib.import_module(MODULE)
    data = at_release(scene, model)
    wrench = np.zeros(6)
    peak = 0.0
    for _ in range(round(scene.run.t_end / model.opt.timestep)):
        mujoco.mj_step(model, data)
        for k in range(data.ncon):
            mujoco.mj_contactForce(model, data, k, wrench)
            peak = max(peak, float(wrench[0]))
    return peak
