"""The numbers of a run's periodic messages by columns, for all samples at once.

Every function gives, bit for bit, what :class:`.messages.Messages` puts into the messages one
by one; fields that are the same in every message (frames, names, zeros) are
left out.  A recording of a long run is written so.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from capture_sim.messages.convert import EPOCH_NS, StringPhase
from capture_sim.samples import SAMPLE, Event, Phase

if TYPE_CHECKING:
    from capture_sim.detection.exact import CaptureStatus
    from capture_sim.launch.plan import LauncherStatus

#: Field's path to its values, (n, ...).
Columns = dict[str, np.ndarray]

_THETA_S, _THETA_P, _H = 2, 3, 4
_CHASER, _TARGET = (0, 1, 2), (5, 6, 7)


def stamps_ns(t: np.ndarray) -> np.ndarray:
    """Return the stamps of times since the release: (n,) ns for s."""
    return EPOCH_NS + np.rint(np.asarray(t) * 1e9).astype(np.int64)


def stamp_columns(stamps: np.ndarray, path: str = "header.stamp") -> Columns:
    """Return the fields of builtin_interfaces/Time of stamps, (n,) ns."""
    return {f"{path}.sec": stamps // 1_000_000_000, f"{path}.nanosec": stamps % 1_000_000_000}


def bench_states(samples: np.ndarray) -> Columns:
    """Return the fields of BenchState."""
    return {name: samples[name] for name in SAMPLE.names or ()}


def buffer_states(samples: np.ndarray) -> Columns:
    """Return the fields of BufferState."""
    v = samples["v"]
    return {
        "axial_stroke": samples["axial_stroke"],
        "axial_rate": v[:, _H],
        "axial_force": samples["axial_force"],
        "torsion": samples["torsion"],
        "torsion_rate": v[:, _THETA_P] - v[:, _THETA_S],
        "torsion_torque": samples["torsion_torque"],
    }


def contact_states(samples: np.ndarray, since: Columns) -> Columns:
    """Return the fields of ContactState; ``since`` from :func:`since_last_message`."""
    names = ("walls", "penetration", "penetration_rate", "normal_force", "friction_force")
    return {
        "in_touch": samples["walls"] != 0,
        **{name: samples[name] for name in names},
        **since,
    }


def string_states(samples: np.ndarray, *, has_string: bool, rail_heading: float) -> Columns:
    """Return the fields of StringState; the rail's heading in rad."""
    return {
        "phase": string_phases(samples, has_string=has_string),
        "tension": samples["string_tension"],
        "mass_height": samples["mass_height"],
        "mass_speed": samples["mass_speed"],
        "chaser_speed": speeds_along(rail_heading, samples["v"]),
    }


def chaser_odometry(samples: np.ndarray) -> Columns:
    """Return the fields of the chaser's Odometry."""
    return _odometry(samples, _CHASER)


def target_odometry(samples: np.ndarray) -> Columns:
    """Return the fields of the target's Odometry."""
    return _odometry(samples, _TARGET)


def contact_wrenches(samples: np.ndarray) -> Columns:
    """Return the fields of WrenchStamped on the tip."""
    force = samples["contact_force"] + samples["latch_force"]
    cos, sin = _cos_sin(samples["q"][:, _THETA_P])
    return {
        "wrench.force.x": cos * force[:, 0] + sin * force[:, 1],
        "wrench.force.y": cos * force[:, 1] - sin * force[:, 0],
        "wrench.torque.z": samples["contact_torque"],
    }


def joint_states(samples: np.ndarray) -> Columns:
    """Return the fields of JointState of hinge and slide."""
    v = samples["v"]
    rate = v[:, _THETA_P] - v[:, _THETA_S]
    return {
        "position": np.stack([samples["torsion"], samples["axial_stroke"]], axis=1),
        "velocity": np.stack([rate, v[:, _H]], axis=1),
        "effort": np.stack([samples["torsion_torque"], samples["axial_force"]], axis=1),
    }


def capture_statuses(statuses: Sequence[CaptureStatus]) -> Columns:
    """Return the fields of CaptureStatus, but for the reason."""
    names = (
        "state",
        "final",
        "distance",
        "axial_offset",
        "lateral_offset",
        "relative_attitude",
        "relative_speed",
        "nearest_distance",
        "time_in_state",
    )
    return _fields(statuses, names)


def launcher_states(statuses: Sequence[LauncherStatus]) -> Columns:
    """Return the fields of LauncherState, but for the reason."""
    names = (
        "state",
        "hanging_mass",
        "drop_height",
        "wanted_speed",
        "landing_speed",
        "measured_speed",
    )
    return _fields(statuses, names)


def since_last_message(samples: np.ndarray, events: Iterable[Event], every: int) -> Columns:
    """Return what the contact did between ContactState messages.

    The whole run at once; the same as :class:`capture_sim.messages.convert.ContactInterval`.

    Parameters
    ----------
    samples
        All of the run, (n,) of dtype SAMPLE.
    events
        All of the run, in order.
    every
        Samples from one message to the next.

    Returns
    -------
    dict
        ``peak_force`` (N), ``impulse`` (N s), ``touches``, (m,) each, one for each message.
    """
    told = samples[::every]
    force = samples["normal_force"].max(axis=1)
    # message k sums up the samples behind message k - 1, and its own
    starts = np.concatenate([[0], np.arange(1, len(force), every)])
    peak = np.maximum(np.maximum.reduceat(force, starts)[: len(told)], 0.0)
    times = told["t"]
    for event in events:
        if event.touch is None:
            continue
        at = int(np.searchsorted(times, event.t, side="right"))  # the first message after it
        before = float(times[at - 2]) if at >= 2 else -math.inf
        if at < len(peak) and event.touch["peak_time"] > before:
            peak[at] = max(peak[at], float(event.touch["peak_force"]))
    impulse = told["impulse"][:, 0] + told["impulse"][:, 1]
    return {
        "peak_force": peak,
        "impulse": np.diff(impulse, prepend=0.0),
        "touches": np.diff(told["touches"], prepend=0),
    }


def string_phases(samples: np.ndarray, *, has_string: bool) -> np.ndarray:
    """Return the phase of the string in samples, (n,), see StringState."""
    if not has_string:
        return np.full(len(samples), int(StringPhase.SLACK))
    known = {Phase.HELD: StringPhase.HELD, Phase.TAUT: StringPhase.TAUT}
    table = np.array([int(known.get(phase, StringPhase.SLACK)) for phase in Phase])
    return table[samples["phase"]]


def speeds_along(heading: float, v: np.ndarray) -> np.ndarray:
    """Return the chaser's speed along a direction (rad) of the world, (n,) m/s, for (n, 8)."""
    return np.asarray(v[:, 0] * math.cos(heading) + v[:, 1] * math.sin(heading))


def _odometry(samples: np.ndarray, body: tuple[int, int, int]) -> Columns:
    x, y, theta = (samples["q"][:, i] for i in body)
    vx, vy, omega = (samples["v"][:, i] for i in body)
    cos, sin = _cos_sin(theta)
    half_cos, half_sin = _cos_sin(theta / 2.0)
    return {
        "pose.pose.position.x": x,
        "pose.pose.position.y": y,
        "pose.pose.orientation.z": half_sin,
        "pose.pose.orientation.w": half_cos,
        "twist.twist.linear.x": cos * vx + sin * vy,
        "twist.twist.linear.y": cos * vy - sin * vx,
        "twist.twist.angular.z": omega,
    }


def _cos_sin(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # by math, as the messages one by one: NumPy's differ in the last bit
    angles = angle.tolist()
    return np.array(list(map(math.cos, angles))), np.array(list(map(math.sin, angles)))


def _fields(objects: Sequence[object], names: Sequence[str]) -> Columns:
    return {name: np.array([getattr(o, name) for o in objects]) for name in names}
