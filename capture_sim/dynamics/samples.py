"""Output of the bench: samples, touches and events, as plain NumPy data.

The fields have the names and units of ``msg/BenchState.msg`` and ``msg/BenchEvent.msg``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np


class Named(IntEnum):
    """Constants of a message, printed by name."""

    @property
    def label(self) -> str:
        """The name used in messages and tables."""
        return self.name.lower()

    def __str__(self) -> str:
        return self.label


class Phase(Named):
    """Phase of a run; in each phase, only its own degrees of freedom are integrated.

    Examples
    --------
    The phases of a launch by the hanging mass, and when each of them begins, s:

    >>> from capture_sim import Phase, simulate
    >>> run, begun = simulate("tilt_0"), {}
    >>> for t, phase in zip(run.t, run.samples["phase"]):
    ...     _ = begun.setdefault(Phase(phase).label, round(float(t), 2))
    >>> begun
    {'taut': 0.0, 'coast': 1.83, 'free': 2.29, 'contact': 2.79, 'latched': 2.94}
    """

    HELD = 0
    TAUT = 1
    COAST = 2
    FREE = 3
    CONTACT = 4
    LATCHED = 5


class EventKind(Named):
    """Kind of an event.

    Examples
    --------
    When the mass landed, and when the latch closed, s:

    >>> from capture_sim import EventKind, simulate
    >>> kinds = (EventKind.LANDED, EventKind.LATCHED)
    >>> [round(event.t, 3) for event in simulate("tilt_0").events if event.kind in kinds]
    [1.827, 2.936]
    """

    RELEASE = 0
    LANDED = 1
    RAIL_END = 2
    TOUCH = 3
    LIFT_OFF = 4
    AT_REST = 5
    MOVING = 6
    LATCHED = 7
    END = 8
    STOP_HIT = 9
    STOP_LEFT = 10
    STICK = 11
    SLIP = 12
    SEATED = 13
    UNSEATED = 14
    THRUST_ON = 15
    THRUST_OFF = 16


#: Order of ``q`` and ``v``.
COORDINATES = ("x_S", "y_S", "theta_S", "theta_P", "h", "x_T", "y_T", "theta_T")

#: The fields of a sample that make up the energy ledger, J.
ENERGIES = (
    "kinetic",
    "elastic_axial",
    "elastic_torsion",
    "elastic_contact",
    "elastic_latch",
    "elastic_stop",
    "work_string",
    "work_thrust",
    "work_floor",
    "dissipated_axial",
    "dissipated_torsion",
    "dissipated_contact",
    "dissipated_friction",
    "dissipated_slide",
    "dissipated_rolling",
    "dissipated_latch",
    "dissipated_stop",
    "dissipated_landing",
    "energy_residual",
)

#: Sample of the full state; fields and units as in msg/BenchState.msg.
SAMPLE = np.dtype(
    [
        ("t", "f8"),
        ("phase", "i8"),
        ("walls", "i8"),
        ("at_rest", "i8"),
        ("touches", "i8"),
        ("q", "f8", (8,)),
        ("v", "f8", (8,)),
        ("axial_stroke", "f8"),
        ("axial_force", "f8"),
        ("torsion", "f8"),
        ("torsion_torque", "f8"),
        ("tip_axial", "f8"),
        ("tip_lateral", "f8"),
        ("tip_distance", "f8"),
        ("penetration", "f8", (2,)),
        ("penetration_rate", "f8", (2,)),
        ("normal_force", "f8", (2,)),
        ("friction_force", "f8", (2,)),
        ("contact_force", "f8", (2,)),
        ("contact_torque", "f8"),
        ("latch_force", "f8", (2,)),
        ("impulse", "f8", (2,)),
        ("thrust", "f8", (6,)),
        ("string_tension", "f8"),
        ("mass_height", "f8"),
        ("mass_speed", "f8"),
        *((name, "f8") for name in ENERGIES),
    ]
)

#: Names of the components of a field, by their number.
_MEMBERS = {
    8: COORDINATES,
    2: ("+y", "-y"),
    6: tuple(f"{vehicle}_{axis}" for vehicle in ("chaser", "target") for axis in "xyz"),
}
_PLANAR = ("contact_force", "latch_force")


def columns_of(fields: np.ndarray | Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the components of all fields of n samples or messages as named columns, (n,) each.

    ``fields`` are samples (n,), or a mapping of names to fields, (n,) or (n, m) each.  Examples of
    column names are ``q.x_S``, ``penetration.+y`` (a wall) and ``contact_force.x``.  If samples
    have no such field, its components are numbered (``position.0``).
    """
    names = fields if isinstance(fields, Mapping) else fields.dtype.names or ()
    columns = {}
    for name in names:
        values = fields[name]
        if values.ndim == 1:
            columns[name] = values
            continue
        count = values.shape[1]
        members: Iterable[object] = range(count)
        if name in (SAMPLE.names or ()) and SAMPLE[name].shape == (count,):
            members = ("x", "y") if name in _PLANAR else _MEMBERS[count]
        columns.update({f"{name}.{member}": values[:, k] for k, member in enumerate(members)})
    return columns


#: State of the contact at the end of an integrator step; fields as in msg/ContactTrace.msg.
TRACE = np.dtype(
    [
        (name, SAMPLE[name])
        for name in (
            *("t", "walls", "q", "v", "tip_axial", "tip_lateral"),
            *("penetration", "penetration_rate", "normal_force", "friction_force", "impulse"),
            *("elastic_contact", "dissipated_contact", "dissipated_friction"),
        )
    ]
)

#: One touch of a wall, from located start to located end.
TOUCH = np.dtype(
    [
        ("start", "f8"),  # s
        ("end", "f8"),  # s; end of the run for a touch that has not ended
        ("wall", "i8"),  # +1 or -1
        ("approach_speed", "f8"),  # m/s, along the normal, at the start
        ("peak_force", "f8"),  # N, normal; maximum of the dense output, also inside steps
        ("peak_time", "f8"),  # s
        ("impulse", "f8"),  # N s, normal
        ("dissipated", "f8"),  # J, contact hysteresis
        ("rate_ratio", "f8"),  # largest rate of penetration / approach speed (v_0)
    ]
)

#: Fields of samples, touches and events by their unit, as in the definitions of the messages.
_FIELDS_OF_UNIT = {
    "s": ("t", "start", "end", "peak_time"),
    "m": ("axial_stroke", "tip_axial", "tip_lateral", "tip_distance", "penetration", "mass_height"),
    "m/s": ("penetration_rate", "mass_speed", "approach_speed"),
    "rad": ("torsion",),
    "N": (
        *("axial_force", "normal_force", "friction_force", "contact_force", "latch_force"),
        *("string_tension", "peak_force"),
    ),
    "N m": ("torsion_torque", "contact_torque"),
    "N s": ("impulse",),
    "J": (*ENERGIES, "dissipated"),
}
_UNITS = {name: unit for unit, names in _FIELDS_OF_UNIT.items() for name in names}


def unit_of_column(column: str) -> str:
    """Return the unit of a column of :func:`columns_of`, e.g. ``v.theta_P``; "" if it has none."""
    field, _, member = column.partition(".")
    if field in ("q", "v"):
        unit = "rad" if member.startswith("theta") else "m"
        return unit if field == "q" else f"{unit}/s"
    if field == "thrust":
        return "N m" if member.endswith("z") else "N"
    return _UNITS.get(field, "")


#: Extremes of a run: peak magnitudes of stroke inwards and outwards (m), torsion (rad), force of
#: the axial buffer with damper, stops and seat (N), torque of the torsional buffer (N m), normal
#: force of each wall (N), force of the latch (N) and penetration (m), and the smallest distance
#: between the tip's centre and the centre of BE (m).
EXTREME_NAMES = (
    "axial_stroke_in",
    "axial_stroke_out",
    "torsion",
    "buffer_force",
    "buffer_torque",
    "normal_force_plus_y",
    "normal_force_minus_y",
    "latch_force",
    "penetration",
    "tip_distance",
)

#: Each extreme with its time (s).
EXTREMES = np.dtype([(f"{name}{end}", "f8") for name in EXTREME_NAMES for end in ("", "_time")])


class Extremes(NamedTuple):
    """Extremes of a run, each of dtype EXTREMES, independent of the sample rate."""

    before_latch: np.void  # until the latch closes, or until the end if it never closes
    after_latch: np.void | None  # since the latch closed; None if it has not closed


@dataclass(frozen=True)
class Event:
    """Event at a located time; a LIFT_OFF event has its ``touch``, a record of dtype TOUCH."""

    kind: EventKind
    t: float  # s, since the release
    q: np.ndarray  # (8,)
    v: np.ndarray  # (8,)
    wall: int = 0  # wall of a touch, lift_off, stick or slip: +1 or -1; 0: none, or unknown
    detail: str = ""
    touch: np.void | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        wall = f", wall {self.wall:+d}" if self.wall else ""
        detail = f": {self.detail}" if self.detail else ""
        return f"Event({self.kind.label} at {self.t:.6g} s{wall}{detail})"
