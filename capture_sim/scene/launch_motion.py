"""Motion of the chaser before the first touch, in closed form.

Its acceleration is constant in each of two phases.  While the hanging mass m_h sinks, it moves
together with the chaser (mass m) and the pulley (I_p, r_p), as one degree of freedom (section 6 of
the paper):

    a = (m_h g - F_roll) / (m + m_h + I_p / r_p^2)

Then the chaser coasts against its rolling resistance F_roll, a = -F_roll / m.  F_roll is less by
the pull of a tilted floor and of a cable along the heading.  Over a distance s of one phase, energy
gives v^2 = v_0^2 + 2 a s.

With a drag c v the acceleration is a - k v, with k = c over the moving mass:

    v(t) = v_0 exp(-k t) + a t phi_1(k t),    s(t) = v_0 t phi_1(k t) + a t^2 phi_2(k t)

with phi_1(x) = (1 - exp(-x)) / x and phi_2(x) = (1 - phi_1(x)) / x.  In the functions below,
``acceleration`` is a, m/s^2, and ``damping`` is k, 1/s.
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
def _phi(x: float) -> tuple[float, float]:
    """Return phi_1 and phi_2, see the module's docstring."""
    if abs(x) > 0.1:
        first = -math.expm1(-x) / x
        return first, (1.0 - first) / x
    # the difference 1 - phi_1 loses its digits: the series of phi_2 does not
    second, term = 0.0, 0.5
    for k in range(3, 14):
        second += term
        term *= -x / k
    return 1.0 - x * second, second


@kernel
def speed_at(speed: float, acceleration: float, damping: float, t: float) -> float:
    """Return the speed (m/s) t s after it was ``speed``."""
    if damping == 0.0:
        return speed + acceleration * t
    return speed * math.exp(-damping * t) + acceleration * t * _phi(damping * t)[0]


@kernel
def distance_at(speed: float, acceleration: float, damping: float, t: float) -> float:
    """Return the distance (m) within t s of a motion that begins with ``speed`` (m/s)."""
    if damping == 0.0:
        return speed * t + 0.5 * acceleration * t * t
    first, second = _phi(damping * t)
    return speed * t * first + acceleration * t * t * second


@kernel
def stop_time(speed: float, acceleration: float, damping: float) -> float:
    """Return when a motion that begins with ``speed`` (m/s) comes to rest, s; ``inf`` if never."""
    if acceleration >= 0.0 or damping * speed <= acceleration:
        return math.inf
    if damping == 0.0:
        return -speed / acceleration
    return math.log1p(-damping * speed / acceleration) / damping


@kernel
def time_after(speed: float, acceleration: float, damping: float, distance: float) -> float:
    """Return the time (s) of a distance (m) that begins with ``speed`` (m/s).

    It is negative for a negative distance, before it, and ``inf`` if the motion ends before.
    """
    if distance == 0.0:
        return 0.0
    square = speed * speed + 2.0 * acceleration * distance
    if damping == 0.0:
        return 2.0 * distance / (speed + math.sqrt(square)) if square > 0.0 else math.inf
    # backwards in time, forces and drag have the other sign
    sign = 1.0 if distance > 0.0 else -1.0
    a, k, s = sign * acceleration, sign * damping, sign * distance
    rest = stop_time(speed, a, k)
    end = speed / k if a == 0.0 and k > 0.0 else math.inf
    if rest < math.inf:
        end = distance_at(speed, a, k, rest)
    if s >= end:
        return math.inf
    # from here on Newton's steps have one sign: the speed rises all the time, or falls
    t = s / speed if speed > 0.0 else math.sqrt(2.0 * s / a)
    for _ in range(60):
        step = (s - distance_at(speed, a, k, t)) / speed_at(speed, a, k, t)
        t += step
        if abs(step) <= 1e-15 * t:
            break
    return sign * t


@kernel
def speed_after(speed: float, acceleration: float, damping: float, distance: float) -> float:
    """Return the speed (m/s) after a distance (m); 0 if the motion ends before.

    ``speed`` (m/s) is that at the distance 0; a negative distance gives the speed before.
    """
    if damping == 0.0:
        square = speed * speed + 2.0 * acceleration * distance
        return math.sqrt(square) if square > 0.0 else 0.0
    t = time_after(speed, acceleration, damping, distance)
    return speed_at(speed, acceleration, damping, t) if t < math.inf else 0.0
