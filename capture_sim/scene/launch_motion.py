"""Motion of the chaser before the first touch, in closed form: its acceleration is constant twice.

While the mass sinks, chaser, mass and pulley are one freedom (``physics`` of the paper's
section 6):

    a = (m_h g - F_roll) / (m + m_h + I_p / r_p^2)

then the chaser coasts against its rolling resistance, a = -F_roll / m.  Over a distance s, energy
gives v^2 = v_0^2 + 2 a s.
"""

from __future__ import annotations

import math

from capture_sim.base.compiled.kernels import kernel


@kernel
def pulled_acceleration(
    hanging_mass: float, gravity: float, rolling: float, mass: float, pulley_mass: float
) -> float:
    """Return the acceleration of chaser and sinking mass, m/s^2; negative if friction is larger.

    ``rolling`` is the chaser's rolling resistance, N; ``pulley_mass`` is I_p / r_p^2, kg.
    """
    return (hanging_mass * gravity - rolling) / (mass + hanging_mass + pulley_mass)


@kernel
def coasting_acceleration(rolling: float, mass: float) -> float:
    """Return the acceleration (m/s^2) of a coasting mass (kg) by its rolling resistance (N)."""
    return -rolling / mass


@kernel
def speed_after(speed: float, acceleration: float, distance: float) -> float:
    """Return the speed (m/s) after a distance (m) from a speed; 0 if it stops before."""
    square = speed * speed + 2.0 * acceleration * distance
    return math.sqrt(square) if square > 0.0 else 0.0


@kernel
def time_between(speed: float, later_speed: float, distance: float) -> float:
    """Return the time (s) over a distance (m) with these speeds (m/s) at its ends."""
    return 2.0 * distance / (speed + later_speed)
