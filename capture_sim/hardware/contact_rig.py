"""A contact in place of hardware: what it gains beyond its law, the loop has made."""

from __future__ import annotations

import numpy as np

from capture_sim.hardware.walls import TipState, WallLaw, Walls, Wrench
from capture_sim.scene.parts import Scene


class ContactRig:
    """Walls with a law.

    Parameters
    ----------
    scene
        The cone and the tip.
    law
        Of either wall.
    stick
        N, by which a wall holds the tip back while it comes out.
    """

    def __init__(self, scene: Scene, law: WallLaw, stick: float = 0.0) -> None:
        self._walls, self._law, self._stick = Walls(scene), law, stick

    def wrench(self, tip: TipState) -> Wrench:
        """Return what the walls do to the tip."""
        fx, fy, torque = self._walls.wrench(self._law, tip)
        if self._stick > 0.0:
            for wall in self._walls.touching(tip):
                if wall.rate < 0.0:
                    fx -= self._stick * wall.nx
                    fy -= self._stick * wall.ny
        return fx, fy, torque


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
