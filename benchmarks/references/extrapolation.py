"""Extrapolation integrator with located touches, in extended precision, for references.

Gragg's modified midpoint rule, extrapolated by Aitken and Neville (Bulirsch and Stoer 1966;
Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, II.9): order 16, no tableau,
no dense output.  Events are located by Newton's method on real steps of trial length, so what is
found is as exact as a step.  Shares nothing with ``capture_sim``'s integration or equations.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.engines.model import Model

Real = np.longdouble
SEQUENCE = (2, 4, 6, 8, 10, 12, 14, 16)
LONGEST_STEP = Real("2e-4")  # s: less than a flight between two touches, or half a period
FIRST_STEP = Real("1e-5")  # s, of a run and of a touch
COLUMNS = ("start", "end", "wall", "approach_speed", "peak_force", "peak_time", "impulse")


class Extrapolation:
    """A run of the bench's free phases, from t = 0.

    Parameters
    ----------
    model
        In extended precision.
    y
        q (8,), v (8,) and both impulses (2,).
    tolerance
        Error a step may make, of the scale of each state.
    scale
        (18,) of each state.
    """

    def __init__(self, model: Model, y: np.ndarray, tolerance: float, scale: np.ndarray) -> None:
        self.model, self.y, self.tolerance, self.scale = model, y.astype(Real), tolerance, scale
        self.t, self.step = Real(0), FIRST_STEP
        self.touches: list[dict[str, Any]] = []
        self.open: list[dict[str, Any] | None] = [None, None]

    def f(self, y: np.ndarray) -> np.ndarray:
        """Evaluate dy/dt."""
        return self.model.rate_of_change(self.t, y)

    def leap(self, h: Any, f_0: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the state after a step of length ``h``, and its error (1: just good enough)."""
        row: list[np.ndarray] = []
        for j, n in enumerate(SEQUENCE):
            part = h / n
            before, now = self.y, self.y + part * f_0
            for _ in range(n - 1):
                before, now = now, before + 2 * part * self.f(now)
            column = [now]
            for k in range(1, j + 1):
                ratio = (Real(n) / SEQUENCE[j - k]) ** 2
                column.append(column[-1] + (column[-1] - row[k - 1]) / (ratio - 1))
            row = column
        error = np.abs(row[-1] - row[-2]) / (self.tolerance * self.scale)
        return row[-1], float(error.max())

    def force_and_rate(self, y: np.ndarray, wall: int) -> tuple[Any, Any]:
        """Return the normal force of a wall (N) and its rate (N/s) in a state."""
        small = Real("1e-9")
        force, later = (
            self.model.normal_force(place, wall) for place in (y, y + small * self.f(y))
        )
        return force, (later - force) / small

    def advance(self, t_end: float) -> np.ndarray:
        """Run to ``t_end`` (s) exactly; return the state there."""
        while self.t < t_end:
            f_0 = self.f(self.y)
            h = min(self.step, LONGEST_STEP, Real(t_end) - self.t)
            while True:
                y_new, error = self.leap(h, f_0)
                factor = 0.9 * max(error, 1e-30) ** (-1.0 / (2 * len(SEQUENCE) - 1))
                if error > 1.0:
                    h *= min(0.9, max(0.1, factor))
                elif self._hides_something(h, y_new):
                    h /= 2
                else:
                    break
            self.step = h * min(4.0, factor)
            self._finish(h, f_0, y_new, t_end)
        return self.y

    def _signed_gap(self, y: np.ndarray, wall: int) -> tuple[Any, Any]:
        """Return a function that goes below zero at the wall's next event, and its rate."""
        gap, rate = self.model.gap(y, wall)
        sign = -1 if self.model.touching[wall] else 1
        return sign * gap, sign * rate

    def _hides_something(self, h: Any, y_new: np.ndarray) -> bool:
        """Return whether a dip below zero may lie inside a step that ends above zero."""
        for wall in (0, 1) if h >= 1e-9 else ():
            g_a, d_a = self._signed_gap(self.y, wall)
            g_b, d_b = self._signed_gap(y_new, wall)
            # both tangents meet below the function's minimum if it is convex
            if g_b > 0 and d_a < 0 < d_b and g_a + d_a * (g_b - g_a - d_b * h) / (d_a - d_b) < 0:
                return True
        return False

    def _finish(self, h: Any, f_0: np.ndarray, y_new: np.ndarray, t_end: float) -> None:
        """Cut the step at its first event, and draw the consequences."""
        events = [
            (*self._locate(h, f_0, wall), wall)
            for wall in (0, 1)
            if self._signed_gap(y_new, wall)[0] < 0
        ]
        if events:
            h, y_new, wall = min(events, key=lambda event: event[0])
        self._watch(h, f_0, y_new)
        is_end = not events and self.t + h >= Real(t_end)
        self.t, self.y = Real(t_end) if is_end else self.t + h, y_new
        if events:
            self._switch(wall)

    def _locate(self, h: Any, f_0: np.ndarray, wall: int) -> tuple[Any, np.ndarray]:
        """Return where in the step a wall's function passes zero downwards, and the state."""
        low, high = Real(0), h
        if self._signed_gap(self.y, wall)[0] < 1e-12:
            # it has just begun from zero: look for a place where it is above
            low = h / 2
            while self._signed_gap(self.leap(low, f_0)[0], wall)[0] <= 0:
                high, low = low, low / 2
        x = high
        for _ in range(60):
            y_inside, _ = self.leap(x, f_0)
            g, d = self._signed_gap(y_inside, wall)
            low, high = (x, high) if g > 0 else (low, x)
            new = x - g / d if d != 0 else (low + high) / 2
            if abs(new - x) < 1e-18:
                break
            x = new if low <= new <= high else (low + high) / 2
        return x, y_inside

    def _watch(self, h: Any, f_0: np.ndarray, y_new: np.ndarray) -> None:
        """Keep the peaks of force."""
        for wall, touch in enumerate(self.open):
            if touch is None:
                continue
            _, before = self.force_and_rate(self.y, wall)
            peak, after = self.force_and_rate(y_new, wall)
            x = h
            if (self.t == touch["start"] or before > 0) and after < 0:
                low, high = Real(0), h
                while high - low >= 1e-8 * h:  # a peak is flat: bisection is enough
                    x = (low + high) / 2
                    peak, slope = self.force_and_rate(self.leap(x, f_0)[0], wall)
                    low, high = (x, high) if slope > 0 else (low, x)
            if peak > touch["peak_force"]:
                touch["peak_force"], touch["peak_time"] = peak, self.t + x

    def _switch(self, wall: int) -> None:
        """Begin or end the touch of a wall, now."""
        touch, impulse = self.open[wall], self.y[16 + wall]
        if touch is not None:
            touch |= {"end": self.t, "impulse": impulse - touch["impulse"]}
            self.touches.append(touch)
            self.open[wall] = None
            self.model.release(wall)
            return
        speed = -self.model.gap(self.y, wall)[1]
        self.model.latch(wall, speed)
        values = (self.t, None, 1 - 2 * wall, speed, Real(0), self.t, impulse)
        self.open[wall] = dict(zip(COLUMNS, values, strict=True))
        self.step = min(self.step, FIRST_STEP)

    def table(self) -> list[list[float | None]]:
        """Return the touches as rows of :data:`COLUMNS`, in order of their starts.

        A touch that is still on has neither end nor impulse.
        """
        touches = self.touches + [
            touch | {"impulse": None} for touch in self.open if touch is not None
        ]
        return [
            [None if touch[name] is None else float(touch[name]) for name in COLUMNS]
            for touch in sorted(touches, key=lambda touch: touch["start"])
        ]
