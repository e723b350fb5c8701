"""Simulated sensors of a bench, with noise, rate and bandwidth.

Every sensor has its own stream of random numbers.  Its readings depend only on the seed and the
run's motion, not on the pace of the simulation, its division into blocks, or other sensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from capture_sim.base.compiled.kernels import plain
from capture_sim.dynamics.model.parameters import pack
from capture_sim.dynamics.model.supports import rolling_wrench
from capture_sim.run.series import Series
from capture_sim.scene.parts import LoadCell, MotionCapture, Scene

Pose = tuple[float, float, float]  # m, m, rad, in the world
Wrench = tuple[float, float, float]  # N, N, N m

# indices into q and v, see samples.COORDINATES
_CHASER, _TARGET = slice(0, 3), slice(5, 8)


class Reading(NamedTuple):
    """Readings at one sample; None for a sensor that is absent or not due at this sample."""

    chaser: Pose | None = None  # by motion capture
    target: Pose | None = None
    wrench: Wrench | None = None  # of the tip on the target, its axes, about its centre of mass


class SimulatedSensors:
    """The sensors of one run of a scene.

    :meth:`read` must be called for every sample at ``run.state_rate``, in order.
    """

    def __init__(self, scene: Scene) -> None:
        self._count = 0
        self._motion_capture: _MotionCapture | None = None
        self._load_cell: _LoadCell | None = None
        parts = scene.sensors
        if parts is None:
            return
        if parts.motion_capture is not None:
            rng = np.random.default_rng([parts.seed, 0])
            self._motion_capture = _MotionCapture(parts.motion_capture, scene, rng)
        if parts.load_cell is not None:
            rng = np.random.default_rng([parts.seed, 1])
            self._load_cell = _LoadCell(parts.load_cell, scene, rng)

    def read(self, sample: np.void) -> Reading:
        """Return the readings of the sensors at the run's next sample, of dtype SAMPLE."""
        k, self._count = self._count, self._count + 1
        chaser = target = wrench = None
        if self._motion_capture is not None and k % self._motion_capture.every == 0:
            chaser, target = self._motion_capture.read(sample) or (None, None)
        if self._load_cell is not None:
            wrench = self._load_cell.read(sample, due=k % self._load_cell.every == 0)
        return Reading(chaser, target, wrench)


class _MotionCapture:
    def __init__(self, part: MotionCapture, scene: Scene, rng: np.random.Generator) -> None:
        self.every = round(scene.run.state_rate / part.rate)
        deviations = [part.position_noise, part.position_noise, part.heading_noise]
        self._deviations = np.array(deviations * 2)
        self._rng = rng
        self._dropout = part.dropout
        self._lost = np.random.default_rng([0 if scene.sensors is None else scene.sensors.seed, 2])
        self._offset = part.offset_x, part.offset_y, part.offset_heading

    def read(self, sample: np.void) -> tuple[Pose, Pose] | None:
        """Return the poses of chaser and target at a sample; None for a frame that is lost."""
        error = (self._deviations * self._rng.standard_normal(6)).tolist()
        if self._dropout and self._lost.random() < self._dropout:
            return None
        c = sample["q"][_CHASER].tolist()
        if any(self._offset):
            x, y, turn = self._offset
            cos, sin = math.cos(c[2]), math.sin(c[2])
            c = [c[0] + cos * x - sin * y, c[1] + sin * x + cos * y, c[2] + turn]
        t = sample["q"][_TARGET].tolist()
        return (
            (c[0] + error[0], c[1] + error[1], c[2] + error[2]),
            (t[0] + error[3], t[1] + error[4], t[2] + error[5]),
        )


class _LoadCell:
    """Load cell under the cone, which measures the tip's wrench on it in the axes of the target.

    The mean wrench between two samples is the target's change of momentum divided by their
    interval, minus the mean wrench of the target's supports.  This is exact even for a touch
    between two samples, which samples of the force would miss.  The mass of the cone is neglected.
    """

    def __init__(self, part: LoadCell, scene: Scene, rng: np.random.Generator) -> None:
        self.every = round(scene.run.state_rate / part.rate)
        self._inertias = (scene.target.mass, scene.target.mass, scene.target.inertia)
        self._L_T = scene.cone.L_T
        self._deviations = np.array([part.force_noise, part.force_noise, part.torque_noise])
        self._rng = rng
        dt = 1.0 / scene.run.state_rate
        self._filters = [low_pass(part.order, part.bandwidth, dt) for _ in range(3)]
        self._rolling = _rolling_of(scene)
        self._last: tuple[float, list[float], Wrench, int] | None = None

    def read(self, sample: np.void, *, due: bool) -> Wrench | None:
        t, v = float(sample["t"]), sample["v"][_TARGET].tolist()
        theta, at_rest = float(sample["q"][7]), int(sample["at_rest"]) & 2
        rolling = self._rolling(sample)
        mean = (0.0, 0.0, 0.0)
        if self._last is not None:
            t_0, v_0, rolling_0, was_at_rest = self._last
            if at_rest and was_at_rest:
                # the supports balance the wrench of the tip
                mean = _tip_wrench(sample, self._L_T)
            else:
                dt = t - t_0
                mean_x, mean_y, mean_m = (
                    m * (b - a) / dt - 0.5 * (r_0 + r)
                    for m, a, b, r_0, r in zip(
                        self._inertias, v_0, v, rolling_0, rolling, strict=True
                    )
                )
                mean = (mean_x, mean_y, mean_m)
        self._last = (t, v, rolling, at_rest)
        c, s = math.cos(theta), math.sin(theta)
        wrench = (c * mean[0] + s * mean[1], c * mean[1] - s * mean[0], mean[2])
        filtered = [
            filtering(value) for filtering, value in zip(self._filters, wrench, strict=True)
        ]
        if not due:
            return None
        x, y, m = (np.array(filtered) + self._deviations * self._rng.standard_normal(3)).tolist()
        return x, y, m


def _tip_wrench(sample: np.void, L_T: float) -> Wrench:
    """Return force (N, N, world axes) and torque (N m) of the tip on the target at a sample.

    The torque is about the target's centre of mass, which is ``L_T`` (m) from the centre of BE.
    """
    fx, fy = (-(sample["contact_force"] + sample["latch_force"])).tolist()
    theta = float(sample["q"][7])
    c, s = math.cos(theta), math.sin(theta)
    px, py = -(float(sample["tip_axial"]) + L_T), float(sample["tip_lateral"])
    rx, ry = c * px - s * py, s * px + c * py
    return fx, fy, rx * fy - ry * fx - float(sample["contact_torque"])


def _rolling_of(scene: Scene) -> Callable[[np.void], Wrench]:
    """Return a function of a sample that returns the supports' wrench on the target.

    The wrench is in world axes, N, N and N m; it is 0 for a scene without supports.
    """
    if scene.supports is None:
        return lambda sample: (0.0, 0.0, 0.0)
    par = pack(scene, math.nan, math.nan)[0]
    balls, v_eps = np.array(par["balls_T"]), float(par["v_eps_ball"])
    resistance = plain(rolling_wrench)

    def rolling(sample: np.void) -> Wrench:
        vx, vy, omega = sample["v"][_TARGET].tolist()
        theta = float(sample["q"][7])
        fx, fy, m, _ = resistance(vx, vy, omega, math.cos(theta), math.sin(theta), balls, v_eps)
        return float(fx), float(fy), float(m)

    return rolling


def low_pass(order: str, bandwidth: float, dt: float) -> Callable[[float], float]:
    """Return a low-pass filter as a function from the next input to the next output.

    An input is the mean of the signal over an interval of ``dt`` (s).  The output, which starts at
    0, belongs to the end of the interval.  The transfer function of order ``"first"`` is
    1 / (1 + s / w), that of order ``"second"`` 1 / (1 + sqrt(2) s / w + (s / w)^2), with w = 2 pi
    times ``bandwidth`` (Hz).  The filter is exact for a signal that is constant within each
    interval, and is therefore stable at any bandwidth.
    """
    w = 2.0 * math.pi * bandwidth
    if order == "first":
        decay = math.exp(-w * dt)
        output = 0.0

        def first(value: float) -> float:
            nonlocal output
            output = value + (output - value) * decay
            return output

        return first
    # y'' + sqrt(2) w y' + w^2 y = w^2 u: poles w (-1 +- i) / sqrt(2); e = y - u decays freely
    a = w / math.sqrt(2.0)
    fade, c, s = math.exp(-a * dt), math.cos(a * dt), math.sin(a * dt)
    output = rate = 0.0

    def second(value: float) -> float:
        nonlocal output, rate
        e = output - value
        output = value + fade * (e * (c + s) + rate / a * s)
        rate = fade * (rate * (c - s) - 2.0 * a * e * s)
        return output

    return second


def sensor_series(scene: Scene, samples: np.ndarray) -> dict[str, Series]:
    """Return the readings of the scene's sensors as series, by quantity.

    ``samples`` must be all samples of the run at ``run.state_rate``.  ``chaser`` and ``target`` are
    poses by motion capture, (n, 3), m, m and rad.  ``cone_force`` is the force on the tip by the
    load cell, (n, 2), N, in the cone's axes.  A quantity without a sensor is absent.
    """
    sensors = SimulatedSensors(scene)
    rows: dict[str, list[tuple[float, ...]]] = {"chaser": [], "target": [], "cone_force": []}
    for sample in samples:
        t, reading = float(sample["t"]), sensors.read(sample)
        if reading.chaser is not None and reading.target is not None:
            rows["chaser"].append((t, *reading.chaser))
            rows["target"].append((t, *reading.target))
        if reading.wrench is not None:
            rows["cone_force"].append((t, -reading.wrench[0], -reading.wrench[1]))
    tables = {name: np.array(of_name) for name, of_name in rows.items() if of_name}
    return {name: Series(table[:, 0], table[:, 1:]) for name, table in tables.items()}
