"""Measurements of a bench at the noise levels of real sensors, as arrays for the rules.

The motion is that of a simulated run; the levels are those of motion capture, encoders and load
cells in catalogues and papers: white and slow noise, bias, latency and jitter, lost frames, bursts,
an occlusion at the contact, outliers, quantised poses, drift and structural noise of the cell.
"""

from __future__ import annotations

from functools import cache

import numpy as np

import capture_sim
from capture_sim.plausibility.measured import Deflections, Forces, Measured, Poses

WALL = 1_760_000_000  # s
#: Overrides of a chaser that flies by itself.
_FREE = ("string=null", "rail=null", "initial.chaser.vx=0.1")
#: Scenes and overrides, whose verdicts are of every kind.
CASES = {
    **{name: (name, ()) for name in ("tilt_0", "tilt_p10", "tilt_m10", "paper_designed")},
    **{name: (name, ()) for name in ("paper_case_1", "paper_case_2", "paper_case_3")},
    **{name: (name, ()) for name in ("paper_undamped", "paper_clamped")},
    "misses beside the cone": ("tilt_0", (*_FREE, "initial.chaser.y=0.15")),
    "grazes the lip": ("tilt_0", (*_FREE, "initial.chaser.y=0.09")),
    "stops before the cone": ("tilt_0", (*_FREE[:-1], "initial.chaser.vx=0.02")),
    "rebounds": ("tilt_0", (*_FREE, "buffer.k_A=30000", "buffer.c_A=0", "initial.chaser.y=0.04")),
    "target turned by 25 deg": ("tilt_0", ("rail.length=0.1", "initial.target.theta='25 deg'")),
    "target turned by -25 deg": ("tilt_0", ("rail.length=0.1", "initial.target.theta='-25 deg'")),
    "chaser turned by 5 deg": ("tilt_0", ("rail.length=0.1", "initial.chaser.theta='5 deg'")),
}


@cache
def motion(name: str) -> tuple[capture_sim.Run, tuple[np.ndarray, np.ndarray]]:
    """Return the simulated run of a case, and times and values of its load cell."""
    scene, changes = CASES[name]
    cell = "sensors.load_cell={force_noise: 0}"
    run = capture_sim.simulate(scene, [cell, *changes])
    [series] = run.series["cone_force"].values()
    return run, (series.t, series.values)


def measured(name: str, seed: int) -> tuple[Measured, capture_sim.Scene]:
    """Return the measurements of a case with the sensors that a seed draws, and the scene."""
    rng = np.random.default_rng(seed)
    run, cell = motion(name)
    turn = rng.choice([0.0, 0.6, -2.5])  # of the world
    frame = str(rng.choice(["world", "map"]))
    latency = {key: float(rng.uniform(0.0, 0.025)) for key in ("poses", "buffer", "force")}
    jitter = float(rng.choice([2e-4, 1e-3, 5e-3]))
    contact = run.first_contact.t if run.first_contact is not None else 2.0
    end = float(run.t[-1])
    origin_of_world = rng.uniform(-2.0, 2.0, 2)

    def arrivals(t: np.ndarray, by: float) -> np.ndarray:
        return np.maximum.accumulate(t + by + np.abs(rng.normal(0.0, jitter, t.size)))

    rate = float(rng.choice([100.0, 120.0, 240.0]))
    frames = np.arange(-1.0, end, 1.0 / rate)
    white = float(rng.choice([5e-5, 2e-4, 3e-4, 1e-3]))
    yaw = float(rng.choice([5e-4, 1e-3, 2.6e-3]))
    tilt = rng.normal(0.0, 5e-3, 2)
    lean = rng.normal(0.0, 5e-3, 2)  # of the floor
    poses = {}
    for vehicle, columns in (("chaser", [0, 1, 2]), ("target", [5, 6, 7])):
        t = frames[rng.random(frames.size) > rng.choice([1e-3, 2e-2])]
        for _ in range(rng.integers(0, 3)):  # bursts
            begin = int(rng.integers(0, t.size - 30))
            t = np.delete(t, slice(begin, begin + int(rng.integers(5, 20))))
        if rng.random() < 0.5:  # the cone hides markers
            hidden = float(rng.choice([0.1, 0.5]))
            begin = contact + float(rng.uniform(-hidden, 0.0))
            t = t[(t < begin) | (t > begin + hidden)]
        before = np.minimum(t, 0.0) * (run.scene.string is None)  # it flies by itself
        x, y, theta = (np.interp(t, run.t, run.q[:, k]) + before * run.v[0, k] for k in columns)
        slow = _slow(rng, t, 1e-4, 10.0)
        bias = rng.uniform(-3e-4, 3e-4, 2)
        x = x + rng.normal(0.0, white, t.size) + slow + bias[0]
        y = y + rng.normal(0.0, white, t.size) + bias[1]
        theta = theta + rng.normal(0.0, yaw, t.size) + turn + rng.uniform(-1e-3, 1e-3)
        if rng.random() < 0.3:  # swapped markers
            for at in np.arange(rng.uniform(0.0, 2.0), end, 4.0):
                k = int(np.searchsorted(t, at))
                x[k : k + 3] += 0.02
                theta[k : k + 3] += 0.026
        if rng.random() < 0.3:  # quantised
            x, y = np.round(x, 4), np.round(y, 4)
        c, s = np.cos(turn), np.sin(turn)
        plane = np.column_stack([c * x - s * y, s * x + c * y]) + origin_of_world
        z = 0.3 + plane @ lean + rng.normal(0.0, white, t.size)
        half = 0.5 * theta
        roll, pitch = (0.5 * (angle + rng.normal(0.0, yaw, t.size)) for angle in tilt)
        quaternion = np.column_stack(
            [
                roll * np.cos(half) + pitch * np.sin(half),
                pitch * np.cos(half) - roll * np.sin(half),
                np.sin(half),
                np.cos(half),
            ]
        )
        poses[vehicle] = Poses(
            f"/motion_capture/{vehicle}",
            t,
            arrivals(t, latency["poses"]),
            (frame,),
            np.column_stack([plane, z]),
            quaternion,
        )
    t = np.arange(-1.0, end, 1.0 / float(rng.choice([100.0, 500.0])))
    stroke = np.interp(t, run.t, run.samples["axial_stroke"]) + rng.normal(0.0, 2e-5, t.size)
    torsion = np.interp(t, run.t, run.samples["torsion"]) + rng.normal(0.0, 1e-4, t.size)
    buffer = Deflections(
        "/joint_states",
        t,
        arrivals(t, latency["buffer"]),
        (),
        stroke=np.round(stroke, 5),
        torsion=torsion,
    )
    t = np.arange(-1.0, end, 1e-3 if rng.random() < 0.7 else 1.0 / 976.0)
    noise = float(rng.choice([0.1, 0.5]))
    drift = float(rng.choice([0.01, 0.05])) * rng.choice([-1.0, 1.0])
    force = np.zeros((t.size, 3))
    for axis in range(2):
        force[:, axis] = -np.interp(t, cell[0], cell[1][:, axis], left=0.0)
        force[:, axis] += rng.normal(0.0, noise, t.size) + rng.uniform(-2.0, 2.0) + drift * (t + 1)
        moving = t > 0.0
        force[moving, axis] += rng.choice([0.0, 0.5]) * rng.normal(size=int(moving.sum()))
    if rng.random() < 0.2:  # output faster than the sampling
        force = np.repeat(force[::4], 4, axis=0)[: t.size]
    force = np.clip(force, -300.0, 300.0)
    wrench = Forces(
        "/load_cell/wrench", t, arrivals(t, latency["force"]), ("target/base_link",), force
    )
    return (
        Measured(poses["chaser"], poses["target"], buffer, wrench, origin=WALL * 10**9),
        run.scene,
    )


def _slow(rng: np.random.Generator, t: np.ndarray, sigma: float, tau: float) -> np.ndarray:
    """Return a Gauss-Markov process (n,) of a standard deviation and time constant, s."""
    step = float(np.median(np.diff(t))) / tau
    walk = np.cumsum(rng.normal(0.0, sigma * np.sqrt(2.0 * step), t.size))
    return walk - walk.mean()
