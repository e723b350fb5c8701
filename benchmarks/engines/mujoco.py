"""The paper's scene in MuJoCo, as near as its contact can be brought.

MuJoCo's contact is linear, its damping viscous and its friction a softened Coulomb law: stiffness
and damping (negative ``solref``) are fitted to the first bounce, and the softness of the friction
to the reference's whole course.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np

from benchmarks.engines import fitted
from benchmarks.trial import Outcome, Trial
from capture_sim.scene.parts import Scene

REFERENCE = ""
NOTE = "RK4 with fixed steps; linear contact, fitted to the first bounce"
#: How fast friction brings slip to rest within its cone, 1/s; of 1e3 to 1e6 the one with the
#: smallest position error at 0.35 s.
_SLIP_DAMPING = 8e3
_FIT_STEP = 2e-6  # s

Solref = tuple[float, float] | None


def trials(scene: Scene, truth: Outcome, quick: bool) -> Iterator[Trial]:
    """Yield the settings to try."""
    solref = functools.cache(lambda: fitted.fit(scene, (2e7, 2e3), bouncing))
    for step in (5e-5,) if quick else (1e-3, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5):
        job = functools.partial(prepare, scene, step, "RK4", solref)
        yield Trial("MuJoCo, fitted", f"step {step:g} s", job, "engine", truth)
    if not quick:
        job = functools.partial(prepare, scene, 2e-3, "Euler", lambda: None)
        yield Trial("MuJoCo, default settings", "step 0.002 s", job, "engine", truth)


def prepare(
    scene: Scene, step: float, integrator: str, solref: Callable[[], Solref]
) -> tuple[Callable[[], None], Callable[[None], Outcome]]:
    """Build the model; return what runs it and what reads the outcome."""
    model = build(scene, step, integrator, solref())
    data, steps = at_release(scene, model), round(scene.run.t_end / step)

    def read(_: None) -> Outcome:
        q = fitted.coordinates(scene, data.qpos)
        if not (np.isfinite(q).all() and np.abs(q).max() < 10.0):
            return Outcome.failed("blew up")
        evaluations = steps * (4 if integrator == "RK4" else 1)
        return Outcome(q, evaluations, peak_force=_peak_force(scene, model, steps))

    return lambda: mujoco.mj_step(model, data, nstep=steps), read


def build(scene: Scene, step: float, integrator: str, solref: Solref) -> Any:
    """Return the model; its joints are those of :func:`fitted.joints`."""
    b, cone, probe = scene.buffer, scene.cone, scene.probe
    friction = scene.friction.mu if scene.friction.law != "none" else 0.0
    contact = ""
    if solref is not None:
        contact = (
            f'solref="{-solref[0]!r} {-solref[1]!r}" solimp="0.999 0.999 0.001" '
            f'solreffriction="-1 {-_SLIP_DAMPING!r}"'
        )

    def inertial(mass: float, inertia: float, x: float = 0.0) -> str:
        about = f"{inertia!r} {inertia!r} {inertia!r}"
        return f'<inertial pos="{x!r} 0 0" mass="{mass!r}" diaginertia="{about}"/>'

    planar = (
        '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
        '<joint type="hinge" axis="0 0 1"/>'
    )
    boxes = "".join(
        f'<geom name="{wall.name}" type="box" size="{0.5 * cone.L_c!r} {fitted.THICKNESS!r} 0.1" '
        f'pos="{wall.x!r} {wall.y!r} 0" axisangle="0 0 1 {wall.angle!r}"/>'
        for wall in fitted.walls(scene)
    )
    pairs = "".join(
        f'<pair geom1="tip" geom2="{wall.name}" condim="3" '
        f'friction="{friction!r} {friction!r} 0 0 0" {contact}/>'
        for wall in fitted.walls(scene)
    )
    return mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <compiler angle="radian" autolimits="false"/>
  <option timestep="{step!r}" integrator="{integrator}" gravity="0 0 0" cone="elliptic"
          tolerance="1e-14" iterations="100"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="chaser">
      {planar} {inertial(scene.chaser.mass, scene.chaser.inertia)}
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
      {planar} {inertial(scene.target.mass, scene.target.inertia)} {boxes}
    </body>
  </worldbody>
  <contact>{pairs}</contact>
</mujoco>""")


def at_release(scene: Scene, model: Any) -> Any:
    """Return the model's data in the scene's initial state."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = fitted.joints(scene)
    return data


def bouncing(scene: Scene) -> fitted.BounceOf:
    """Return what tries a contact on the first bounce."""

    def bounce_of(stiffness: float, damping: float) -> tuple[float, np.ndarray]:
        model = build(scene, _FIT_STEP, "RK4", (stiffness, damping))
        data, touching = at_release(scene, model), 0
        for _ in range(round(scene.run.t_end / _FIT_STEP)):
            mujoco.mj_step(model, data)
            touching += data.ncon > 0
            if touching and not data.ncon:
                break
        return touching * _FIT_STEP, np.array(data.qvel[5:7])

    return bounce_of


def _peak_force(scene: Scene, model: Any, steps: int) -> float:
    """Return the largest normal force, N, looked at after each step."""
    data, wrench, peak = at_release(scene, model), np.zeros(6), 0.0
    for _ in range(steps):
        mujoco.mj_step(model, data)
        for k in range(data.ncon):
            mujoco.mj_contactForce(model, data, k, wrench)
            peak = max(peak, float(wrench[0]))
    return peak
