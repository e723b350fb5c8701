"""Chaser, probe and target in a row, written a second time: three points on a line, by SciPy.

No code in common with capture_sim, the contact laws' factor apart (tested on its own).
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import solve_ivp

from capture_sim.scene.laws import HYSTERESIS_FACTOR
from capture_sim.scene.parts import Scene


class Row:
    """Three points with displacements x and speeds v (3,): chaser, probe, target.

    Parameters
    ----------
    scene
        Masses, buffer, contact and stops.
    gap
        Of tip and wall to begin with, m.
    speeds
        (3,) to begin with, m/s.
    slowing
        Constant force against each point's motion, N, for as long as it lasts.

    Attributes
    ----------
    events : list of (label, time)
        Touches, lift-offs, and when the compressed stop was met and left.
    """

    def __init__(self, scene: Scene, gap, speeds, slowing=(0.0, 0.0, 0.0)) -> None:
        p, c = scene.probe, scene.contact
        rod = p.density * math.pi * p.radius**2 * p.length
        ball = p.density * 4 / 3 * math.pi * p.tip_radius**3
        self.m = np.array([scene.chaser.mass + scene.cylinder.mass, rod + ball, scene.target.mass])
        soft = (1 - c.tip.nu**2) / c.tip.E + (1 - c.wall.nu**2) / c.wall.E
        self.K = 4 / 3 * math.sqrt(p.tip_radius) / soft
        self.a = HYSTERESIS_FACTOR[c.law](c.restitution)
        self.v_0_floor = c.min_approach_speed
        self.buffer, self.stops = scene.buffer, scene.stops
        self.gap, self.slowing = gap, np.array(slowing)
        self.t, self.y = 0.0, np.array([0.0, 0.0, 0.0, *speeds])
        self.touching = self.stopped = False
        self.chi = 0.0
        self.events: list[tuple[str, float]] = []

    def depth(self, y) -> float:
        return y[1] - y[2] - self.gap

    def contact_force(self, y) -> float:
        depth = self.depth(y)
        if not self.touching or depth <= 0.0:
            return 0.0
        return max(depth**1.5 * (self.K + self.chi * (y[4] - y[5])), 0.0)

    def motion(self, t, y):
        stroke, rate = y[1] - y[0], y[4] - y[3]
        push = -self.buffer.k_A * stroke - self.buffer.c_A * rate
        if self.stopped:
            into = -self.stops.compression - stroke
            push += max(self.stops.stiffness * into - self.stops.damping * rate, 0.0)
        contact = self.contact_force(y)
        force = np.array([-push, push - contact, contact]) - self.slowing
        return np.array([*y[3:], *(force / self.m)])

    def run(self, t_end: float, tolerance: float = 1e-11) -> Row:
        """Run on to ``t_end`` (s), event by event."""
        while self.t < t_end:

            def wall(t, y):
                return self.depth(y)

            wall.terminal, wall.direction = True, -1 if self.touching else 1
            watched = [wall]
            if self.stops is not None:

                def stop(t, y):
                    return y[1] - y[0] + self.stops.compression

                stop.terminal, stop.direction = True, 1 if self.stopped else -1
                watched.append(stop)
            how = {"method": "DOP853", "rtol": tolerance, "atol": 1e-4 * tolerance}
            # what has just begun must be under way before its end is looked for
            start = min(self.t + 1e-9, t_end)
            ahead = solve_ivp(self.motion, (self.t, start), self.y, **how).y[:, -1]
            piece = solve_ivp(self.motion, (start, t_end), ahead, events=watched, **how)
            self.t, self.y = piece.t[-1], piece.y[:, -1]
            if piece.status != 1:
                break
            if piece.t_events[0].size:
                self.touching = not self.touching
                if self.touching:
                    self.chi = self.a * self.K / max(self.y[4] - self.y[5], self.v_0_floor)
                self.events.append(("touch" if self.touching else "lift_off", self.t))
            else:
                self.stopped = not self.stopped
                self.events.append(("stop_hit" if self.stopped else "stop_left", self.t))
        return self

    def times(self, label: str) -> np.ndarray:
        """When something happened, s."""
        return np.array([t for name, t in self.events if name == label])
