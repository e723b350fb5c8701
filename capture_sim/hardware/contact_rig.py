"""A contact that loses nothing, in place of hardware: what it gains, the loop has made."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from capture_sim.hardware.in_the_loop import LoopStage, SafeStopError, TipState, Wrench
from capture_sim.kernels import plain
from capture_sim.model.geometry import nearest_on_wall
from capture_sim.scene.parts import Scene

_nearest_on_wall = plain(nearest_on_wall)


class ContactRig:
    """Elastic walls without friction: F_n = stiffness * penetration^exponent.

    Parameters
    ----------
    scene
        The cone and the tip.
    stiffness
        N/m^exponent, of either wall.
    exponent
        1 for a spring, 1.5 for Hertz.
    """

    def __init__(self, scene: Scene, stiffness: float, exponent: float = 1.0) -> None:
        self._cone, self._radius = scene.cone, scene.probe.tip_radius
        self._cos, self._sin = math.cos(scene.cone.half_angle), math.sin(scene.cone.half_angle)
        self._stiffness, self._exponent = stiffness, exponent

    def wrench(self, tip: TipState) -> Wrench:
        """Return what the walls do to the tip."""
        fx = fy = 0.0
        for side in (1.0, -1.0):
            penetration, nx, ny = self.penetration(tip.x, tip.y, side)
            if penetration > 0.0:
                force = self._stiffness * penetration**self._exponent
                fx += force * nx
                fy += force * ny
        return fx, fy, 0.0

    def penetration(self, x: float, y: float, side: float) -> tuple[float, float, float]:
        """Return penetration (m, negative is a gap) and the normal in the target's axes."""
        distance, n_u, n_Y = _nearest_on_wall(
            -x, side * y, self._cone.R_c, self._cone.L_c, self._cos, self._sin
        )
        return self._radius - distance, -n_u, side * n_Y


class Bounce(NamedTuple):
    """The first touch of a loop, from its first force to its last.

    Attributes
    ----------
    duration
        s.
    approach_speed
        m/s, along the force.
    energy
        J, of that motion before: half the effective mass times its square.
    work
        J, of the wrench: what the loop has made.
    peak_force
        N.
    stopped
        Why the loop had to be opened meanwhile; empty if it had not.
    """

    duration: float
    approach_speed: float
    energy: float
    work: float
    peak_force: float
    stopped: str = ""

    @property
    def restitution(self) -> float:
        """Speed after over speed before, from the energy; inf where the loop was opened."""
        if self.stopped:
            return math.inf
        return math.sqrt(max(1.0 + self.work / self.energy, 0.0))


class BounceWatch:
    """Measures the first touch of a stage; to be told of every step.

    Parameters
    ----------
    stage
        Before its first step.
    mass
        kg, that the contact feels; None takes that of the tip at the first force, which is
        right for a touch much shorter than the buffer's own motion.
    """

    def __init__(self, stage: LoopStage, mass: float | None = None) -> None:
        self._stage = stage
        self._mass = mass
        self._speed = self._energy = self._work = self._peak = 0.0
        self._begin: float | None = None
        self._end: float | None = None

    def before(self, wrench: Wrench) -> None:
        """See the wrench that the stage is about to go a step with."""
        force = math.hypot(wrench[0], wrench[1])
        if self._end is not None:
            return
        if force > 0.0 and self._begin is None:
            nx, ny = wrench[0] / force, wrench[1] / force
            tip = self._stage.tip
            self._begin, self._work = self._stage.t, self._stage.work
            self._speed = -(tip.vx * nx + tip.vy * ny)
            mass = self._stage.effective_mass(nx, ny) if self._mass is None else self._mass
            self._energy = 0.5 * mass * self._speed**2
        elif force == 0.0 and self._begin is not None:
            self._end = self._stage.t
            self._work = self._stage.work - self._work
        self._peak = max(self._peak, force)

    @property
    def over(self) -> bool:
        """Whether the touch has ended."""
        return self._end is not None

    def bounce(self, stopped: str = "") -> Bounce | None:
        """Return what was measured; None without a touch."""
        if self._begin is None:
            return None
        end = self._stage.t if self._end is None else self._end
        work = self._work if self.over else self._stage.work - self._work
        return Bounce(end - self._begin, self._speed, self._energy, work, self._peak, stopped)


def bounce_with_delay(
    scene: Scene,
    rig: ContactRig,
    delay: float,
    step: float,
    t_end: float,
    substeps: int = 4,
    mass: float | None = None,
) -> Bounce | None:
    """Close the loop without DDS: the wrench answers the tip's place of ``delay`` before.

    Parameters
    ----------
    scene
        See :class:`LoopStage`.
    rig
        The contact.
    delay
        s, a whole number of steps; the hold adds half a step.
    step
        s.
    t_end
        s, when it is given up.
    substeps, mass
        See :class:`LoopStage` and :class:`BounceWatch`.

    Returns
    -------
    Bounce or None
        The first touch.
    """
    stage = LoopStage(scene, step, substeps)
    watch = BounceWatch(stage, mass)
    late = round(delay / step)
    places: deque[TipState] = deque([stage.tip], maxlen=late + 1)
    try:
        for _ in range(math.ceil(t_end / step)):
            wrench = rig.wrench(places[0])
            watch.before(wrench)
            if watch.over:
                break
            places.append(stage.advance(wrench))
    except SafeStopError as stop:
        return watch.bounce(str(stop))
    return watch.bounce()


def gain_rate(exponent: float) -> float:
    """Return by what a touch gains energy at a small delay, times duration over delay.

    To first order in the delay the force is that of the present penetration less
    ``delay * dF/dt``, which feeds in ``delay * integral of F' v^2 dt`` (the negative damping
    of a delayed spring).  Over the energy of the approach that is 2 gain_rate delay /
    duration, so the restitution grows as exp(gain_rate delay / duration).  For a spring it
    is pi^2 / 2.

    Notes
    -----
    By quadrature over z = (x / x_max), v = v_0 sqrt(1 - z^(p + 1)), with
    x_max^(p + 1) = (p + 1) m v_0^2 / (2 K); z = 1 - s^2 takes the root's end away.
    """
    s, weights = np.polynomial.legendre.leggauss(200)
    s, weights = 0.5 * (s + 1.0), 0.5 * weights
    z = 1.0 - s**2
    root = np.sqrt(1.0 - z ** (exponent + 1.0))
    # in units of x_max and v_0: duration, and the integral of F' v^2 dt over m v_0^2
    duration = 2.0 * float(np.sum(weights * 2.0 * s / root))
    stiffness = 0.5 * (exponent + 1.0) * exponent * z ** (exponent - 1.0)
    fed = 2.0 * float(np.sum(weights * 2.0 * s * stiffness * root))
    return fed * duration
