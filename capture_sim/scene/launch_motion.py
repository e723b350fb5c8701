"""Motion of the chaser before the first touch, in closed form.

Its acceleration is constant in each of two phases.  While the hanging mass m_h sinks, it moves
together with the chaser (mass m) and the pulley (I_p, r_p), as one degree of freedom (section 6 of
the paper):

    a = (m_h g - F_roll) / (m + m_h + I_p / r_p^2)

Then the chaser coasts against its rolling resistance F_roll, a = -F_roll / m.  On a tilted floor
F_roll is less by the pull along the heading.  Over a distance s of
one phase, energy gives v^2 = v_0^2 + 2 a s.
"""

from __future__ import annotations

import math

from capture_sim.base.compiled.kernels import kernel


@kernel
def pulled_acceleration(
    hanging_mass: float, gravity: float, rolling: float, mass: float, pulley_mass: float
) -> float:
    """Return the acceleration of the chaser while the hanging mass pulls it, m/s^2.

    It is negative if the rolling resistance exceeds the weight of the hanging mass.
    ``hanging_mass`` and ``mass``, that of the complete chaser, are in kg, ``gravity`` in m/s^2;
    ``rolling`` is the chaser's rolling resistance, N; ``pulley_mass`` is the pulley's moment of
    inertia divided by the square of its radius, kg.
    """
    return (hanging_mass * gravity - rolling) / (mass + hanging_mass + pulley_mass)


@kernel
def coasting_acceleration(rolling: float, mass: float) -> float:
    """Return the acceleration (m/s^2) of a coasting mass (kg) by a resistance (N)."""
    return -rolling / mass


@kernel
def speed_after(speed: float, acceleration: float, distance: float) -> float:
    """Return the speed (m/s) after a distance (m) at constant acceleration (m/s^2).

    The result is 0 if the motion ends before.  ``speed`` (m/s) is that at the distance 0; a
    negative distance gives the speed before.
    """
    square = speed * speed + 2.0 * acceleration * distance
    return math.sqrt(square) if square > 0.0 else 0.0


@kernel
def time_between(speed: float, later_speed: float, distance: float) -> float:
    """Return the time (s) for a distance (m) at constant acceleration.

    ``speed`` and ``later_speed`` (m/s) are those at its start and its end; not both are 0.
    """
    return 2.0 * distance / (speed + later_speed)
