"""Parts of a scene: frozen dataclasses in SI units, checked when they are created.

A part that is ``None`` is not on the bench and needs no computing time.  Symbols, and the numbers
of equations and tables, are those of the paper (A New Buffer in Impact Reduction for Aerospace
Applications, Table 1 and 2).

Every number is declared as a :func:`~capture_sim.scene.quantities.quantity`, which holds its unit
and allowed range, every measured curve as :func:`~capture_sim.scene.quantities.points`.
:func:`capture_sim.scene.loading.check_scene` checks the rules that tie several parts together.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from capture_sim.base.notebook import drawn, html_table
from capture_sim.errors import SceneError
from capture_sim.scene.laws import CONTACT_LAWS, FRICTION_LAWS
from capture_sim.scene.quantities import (
    ANY,
    NOT_NEGATIVE,
    POSITIVE,
    Checked,
    Range,
    choice,
    points,
    quantity,
    shown,
)
from capture_sim.scene.yaml_text import yaml_text

#: Exponent of the penetration between a sphere and a plane (Hertz).
HERTZ = 1.5
#: Range of the detector's lengths, m; a length above one metre indicates a wrong unit.
DETECTOR_LENGTH = Range(0.0, 1.0, low_open=True)
#: Largest number of points of a measured curve.
MAX_TABLE_POINTS = 64
METHODS = ("dop853", "dopri5", "rk4")
FILTERS = ("first", "second")


@dataclass(frozen=True)
class Vehicle(Checked):
    """A vehicle's main body, without the buffer (Table 2)."""

    mass: float = quantity("kg", POSITIVE, doc="mass of the body, m_S or m_T")
    inertia: float = quantity(
        "kg m^2", POSITIVE, doc="moment of inertia about the centre of mass, I_S or I_T"
    )
    drag: float = quantity(
        "N s/m",
        NOT_NEGATIVE,
        default=0.0,
        doc="force against the body's velocity over its speed, e.g. of the air",
    )
    cable_x: float = quantity(
        "N", ANY, default=0.0, doc="constant force on the body along x, e.g. of a cable"
    )
    cable_y: float = quantity("N", ANY, default=0.0, doc="constant force along y")

    @property
    def besides(self) -> tuple[float, float, float]:
        """Drag (N s/m) and constant force (x, y; N)."""
        return self.drag, self.cable_x, self.cable_y


@dataclass(frozen=True)
class Cylinder(Checked):
    """The cylinder hinged to the chaser; a slender rod behind the hinge (eq. 6)."""

    mass: float = quantity("kg", NOT_NEGATIVE, doc="mass of the cylinder, m_C")
    length: float = quantity("m", NOT_NEGATIVE, doc="length of the cylinder behind the hinge, L_C")

    @property
    def inertia(self) -> float:
        """Moment of inertia about the cylinder's centre, kg m^2."""
        return self.mass * self.length**2 / 12.0


@dataclass(frozen=True)
class Probe(Checked):
    """The probe: a solid rod that ends in a solid sphere, the tip mass."""

    radius: float = quantity("m", POSITIVE, doc="radius of the rod, r_p")
    length: float = quantity("m", POSITIVE, doc="length of the rod, L_p")
    tip_radius: float = quantity("m", POSITIVE, doc="radius of the tip sphere, R_t")
    density: float = quantity("kg/m^3", POSITIVE, doc="density of rod and tip sphere")

    @cached_property
    def rod_mass(self) -> float:
        """Mass of the rod, kg."""
        return self.density * math.pi * self.radius**2 * self.length

    @cached_property
    def tip_mass(self) -> float:
        """Mass of the sphere, kg."""
        return self.density * 4.0 / 3.0 * math.pi * self.tip_radius**3

    @cached_property
    def mass(self) -> float:
        """Mass of rod and sphere, kg."""
        return self.rod_mass + self.tip_mass

    @cached_property
    def com_offset(self) -> float:
        """Distance from the tip's centre back to the probe's centre of mass, m."""
        return self.rod_mass * (self.tip_radius + self.length / 2.0) / self.mass

    @cached_property
    def inertia(self) -> float:
        """Moment of inertia about the probe's own centre of mass, kg m^2."""
        d = self.com_offset
        rod = self.rod_mass * (self.length**2 / 12.0 + self.radius**2 / 4.0)
        rod += self.rod_mass * (self.tip_radius + self.length / 2.0 - d) ** 2
        return rod + self.tip_mass * (0.4 * self.tip_radius**2 + d**2)


@dataclass(frozen=True)
class Buffer(Checked):
    """The 2-DOF buffer: axial spring-damper and torsional spring (eq. 9)."""

    hinge_offset: float = quantity(
        "m", NOT_NEGATIVE, doc="distance from the chaser's centre of mass to the hinge, a"
    )
    k_A: float = quantity("N/m", NOT_NEGATIVE, doc="stiffness of the axial spring")
    c_A: float = quantity("N s/m", NOT_NEGATIVE, doc="damping coefficient of the axial damper")
    k_T: float = quantity("N m/rad", NOT_NEGATIVE, doc="stiffness of the torsional spring")
    c_T: float = quantity(
        "N m s/rad", NOT_NEGATIVE, default=0.0, doc="damping coefficient of the torsional damper"
    )
    rest_length: float | None = quantity(
        "m",
        POSITIVE,
        default=None,
        doc="distance from the hinge to the tip's centre with the buffer at rest, h_0; "
        "null: L_p + R_t",
    )
    k_A3: float = quantity(
        "N/m^3", NOT_NEGATIVE, default=0.0, doc="cubic stiffness of a progressive axial spring"
    )
    c_A2: float = quantity(
        "N s^2/m^2", NOT_NEGATIVE, default=0.0, doc="quadratic (orifice) axial damping"
    )
    c_A_rebound: float | None = quantity(
        "N s/m",
        NOT_NEGATIVE,
        default=None,
        doc="damping coefficient of the axial damper while the probe moves outwards; null: c_A",
    )
    preload: float = quantity(
        "N",
        NOT_NEGATIVE,
        default=0.0,
        doc="force with which the axial spring presses the probe outwards against a rigid seat at "
        "the rest length; 0: no seat",
    )
    k_T3: float = quantity(
        "N m/rad^3",
        NOT_NEGATIVE,
        default=0.0,
        doc="cubic stiffness of a progressive torsional spring",
    )
    c_T2: float = quantity(
        "N m s^2/rad^2", NOT_NEGATIVE, default=0.0, doc="quadratic torsional damping"
    )
    friction: float = quantity(
        "N",
        NOT_NEGATIVE,
        default=0.0,
        doc="Coulomb friction of the probe in its slide, static and sliding; 0: none",
    )
    force_table: tuple[tuple[float, float], ...] | None = points(
        ("stroke inwards", "force outwards"),
        ("m", "N"),
        (2, MAX_TABLE_POINTS),
        default=None,
        doc="measured force of the axial spring over its stroke, in place of k_A, k_A3 and "
        "preload, from stroke 0 on; a first force above 0 is the preload; null: no table",
    )

    @property
    def seat_force(self) -> float:
        """Force of the axial spring on the probe's seat at the rest length, N; 0: no seat.

        The seat is a rigid stop that keeps the probe from moving outwards beyond its rest length.
        """
        return self.preload if self.force_table is None else self.force_table[0][1]

    @property
    def stiffness_at_rest(self) -> float:
        """Stiffness of the axial spring at the rest length, N/m.

        It is ``k_A``, or the slope between the first two points of ``force_table``.
        """
        if self.force_table is None:
            return self.k_A
        (stroke_0, force_0), (stroke_1, force_1) = self.force_table[:2]
        return (force_1 - force_0) / (stroke_1 - stroke_0)


@dataclass(frozen=True)
class Cone(Checked):
    """The target's cone: inner edge BE, and a wall on each side of the axis."""

    L_T: float = quantity(
        "m",
        NOT_NEGATIVE,
        doc="distance from the target's centre of mass to BE, the inner edge of the cone",
    )
    R_c: float = quantity("m", POSITIVE, doc="half-width of BE")
    L_c: float = quantity("m", POSITIVE, doc="length of the wall along its generatrix")
    half_angle: float = quantity(
        "rad",
        Range(0.0, math.pi / 2, low_open=True, high_open=True),
        doc="angle between wall and axis, beta; 45 deg is written '45 deg'",
    )

    @property
    def wall(self) -> tuple[float, float, float, float]:
        """R_c, L_c (m), cos beta and sin beta: a wall in :mod:`capture_sim.scene.geometry`."""
        return self.R_c, self.L_c, math.cos(self.half_angle), math.sin(self.half_angle)

    @property
    def mouth(self) -> float:
        """Distance of the cone's mouth from BE along the axis, m."""
        return self.L_c * math.cos(self.half_angle)


@dataclass(frozen=True)
class Material(Checked):
    """An isotropic elastic material (eq. 3)."""

    E: float = quantity("N/m^2", POSITIVE, doc="Young's modulus")
    nu: float = quantity("1", Range(-1.0, 0.5, low_open=True), doc="Poisson's ratio")

    @property
    def sigma(self) -> float:
        """Compliance of the material in contact, (1 - nu^2) / E, m^2/N."""
        return (1.0 - self.nu**2) / self.E


@dataclass(frozen=True)
class Contact(Checked):
    """Normal contact of tip and cone wall (eq. 1 to 4)."""

    tip: Material
    wall: Material
    restitution: float = quantity(
        "1", Range(0.0, 1.0), doc="coefficient of restitution e, the argument of the law"
    )
    law: str = choice(
        CONTACT_LAWS, default="lankarani_nikravesh", doc="law of the hysteresis damping factor"
    )
    min_approach_speed: float = quantity(
        "m/s", POSITIVE, default=1e-4, doc="lower limit of the approach speed in the damping factor"
    )
    hysteresis_factor: float | None = quantity(
        "1",
        NOT_NEGATIVE,
        default=None,
        doc="hysteresis damping factor a itself, in place of law and restitution; null: a(e) of "
        "the law",
    )
    stiffness: float | None = quantity(
        "N/m^p",
        POSITIVE,
        default=None,
        doc="stiffness K of the elastic force K delta^p; null: eq. (2), of both materials",
    )
    exponent: float = quantity(
        "1",
        Range(1.0, 3.0),
        default=HERTZ,
        doc="exponent p of the penetration: 1 a spring, 1.5 Hertz; another needs stiffness",
    )
    force_table: tuple[tuple[float, float], ...] | None = points(
        ("depth", "force"),
        ("m", "N"),
        (2, MAX_TABLE_POINTS),
        default=None,
        doc="measured elastic force over the penetration, in place of stiffness and exponent, from "
        "depth 0 on; a point listed twice is a kink; null: no table",
    )


@dataclass(frozen=True)
class Friction(Checked):
    """Coulomb friction of the tip on the wall."""

    mu: float = quantity("1", NOT_NEGATIVE, doc="coefficient of sliding friction")
    law: str = choice(
        FRICTION_LAWS, default="tanh", doc="friction law, i.e. how it is regularised at zero slip"
    )
    slip_regularization_speed: float = quantity(
        "m/s", POSITIVE, default=1e-3, doc="slip speed at which tanh reaches 76 % of mu F_n, v_eps"
    )
    mu_s: float | None = quantity(
        "1",
        NOT_NEGATIVE,
        default=None,
        doc="coefficient of static friction, for brown_mcphee and coulomb; null: mu",
    )


@dataclass(frozen=True)
class BallSupport(Checked):
    """Three ball-shaped supports under a vehicle."""

    balls: tuple[tuple[float, float], ...] = points(
        ("x", "y"), ("m", "m"), (3, 3), doc="x, y of the three balls in the vehicle's frame"
    )
    c_rr: float = quantity("1", Range(0.0, 1.0), doc="coefficient of rolling resistance")


@dataclass(frozen=True)
class Supports(Checked):
    """Supports of both vehicles on the floor."""

    chaser: BallSupport
    target: BallSupport
    rolling_regularization_speed: float = quantity(
        "m/s",
        POSITIVE,
        default=1e-6,
        doc="ball speed below which rolling resistance decreases to zero; a vehicle may come "
        "to rest below five times this speed",
    )


@dataclass(frozen=True)
class Floor(Checked):
    """Level of the floor, and of rail and supports with it; the hanging mass hangs plumb."""

    tilt_x: float = quantity(
        "rad",
        Range(-0.1, 0.1),
        default=0.0,
        doc="slope along x; positive: the floor descends towards +x, where gravity pulls",
    )
    tilt_y: float = quantity(
        "rad", Range(-0.1, 0.1), default=0.0, doc="slope along y; positive: it descends towards +y"
    )


@dataclass(frozen=True)
class Rail(Checked):
    """Straight rail that guides the chaser along its initial heading."""

    length: float = quantity(
        "m", POSITIVE, doc="distance the chaser travels before it leaves the rail"
    )


@dataclass(frozen=True)
class String(Checked):
    """String, pulley and hanging mass.

    Of ``impact_speed``, ``hanging_mass`` and ``drop_height`` two are given; the third (null) is
    computed from them.
    """

    impact_speed: float | None = quantity(
        "m/s",
        POSITIVE,
        default=None,
        doc="speed of the chaser at the first contact; null: computed",
    )
    hanging_mass: float | None = quantity(
        "kg", POSITIVE, default=None, doc="mass on the string, m_h; null: computed"
    )
    drop_height: float | None = quantity(
        "m", POSITIVE, default=None, doc="height of the mass above its landing; null: computed"
    )
    pulley_inertia: float = quantity(
        "kg m^2", NOT_NEGATIVE, default=0.0, doc="moment of inertia of the pulley, I_p"
    )
    pulley_radius: float = quantity("m", POSITIVE, default=0.02, doc="radius of the pulley")

    @property
    def pulley_mass(self) -> float:
        """Mass that the pulley adds to what moves, I_p / r_p^2, kg."""
        return self.pulley_inertia / self.pulley_radius**2


@dataclass(frozen=True)
class Latch(Checked):
    """Spring-loaded latches that hold the tip after it has reached BE.

    A spring and a damper in each direction hold the tip where it was caught; the walls no longer
    act on it.
    """

    radius: float = quantity(
        "m",
        POSITIVE,
        doc="distance from the tip's centre to the centre of BE at which the latches close",
    )
    stiffness: float = quantity("N/m", POSITIVE, doc="stiffness of the latched tip's spring")
    damping: float = quantity(
        "N s/m", NOT_NEGATIVE, doc="damping coefficient of the latched tip's damper"
    )


@dataclass(frozen=True)
class Stops(Checked):
    """Ends of the probe's stroke: springs with dampers that push but never pull."""

    compression: float = quantity(
        "m", POSITIVE, doc="inward stroke at which the probe meets the stop"
    )
    extension: float | None = quantity(
        "m",
        POSITIVE,
        doc="outward stroke at which the probe meets the stop; null: no stop outwards, as with "
        "buffer.preload, whose seat is there",
    )
    stiffness: float = quantity("N/m", POSITIVE, doc="stiffness of each stop")
    damping: float = quantity("N s/m", NOT_NEGATIVE, doc="damping coefficient of each stop")


@dataclass(frozen=True)
class Thruster(Checked):
    """Thrusters of a vehicle: what they can do with a commanded wrench.

    A wrench is held between commands, in the vehicle's axes, at its centre of mass.
    """

    force: float = quantity("N", POSITIVE, doc="largest force along each axis; more is cut")
    torque: float = quantity("N m", POSITIVE, doc="largest moment; more is cut")
    delay: float = quantity(
        "s", Range(0.0, 10.0), default=0.0, doc="delay from a command to its wrench"
    )
    min_hold: float = quantity(
        "s",
        Range(0.0, 10.0),
        default=0.0,
        doc="shortest time for which a wrench is held; an earlier command waits",
    )


@dataclass(frozen=True)
class Thrusters(Checked):
    """Thrusters on the vehicles, which a controller commands."""

    chaser: Thruster | None = None
    target: Thruster | None = None
    timeout: float = quantity(
        "s",
        Range(0.0, 1e6, low_open=True),
        default=0.5,
        doc="time after which a wrench without a new command ends",
    )


@dataclass(frozen=True)
class PlanarState(Checked):
    """Pose and velocity of a vehicle's centre of mass in the world."""

    x: float = quantity("m", default=0.0, doc="position of the centre of mass along x")
    y: float = quantity("m", default=0.0, doc="position of the centre of mass along y")
    theta: float = quantity(
        "rad", Range(-math.pi, math.pi), default=0.0, doc="heading, from x towards y"
    )
    vx: float = quantity("m/s", default=0.0, doc="velocity of the centre of mass along x")
    vy: float = quantity("m/s", default=0.0, doc="velocity of the centre of mass along y")
    omega: float = quantity("rad/s", default=0.0, doc="angular velocity")

    @property
    def moves(self) -> bool:
        """True unless the vehicle is at rest."""
        return bool(self.vx or self.vy or self.omega)


@dataclass(frozen=True)
class Initial(Checked):
    """Initial states of both vehicles; the buffer starts at rest."""

    chaser: PlanarState
    target: PlanarState


#: Smallest tolerance above round-off, and shortest fixed step, s.
MIN_RTOL, MIN_STEP = 1e-13, 1e-9


@dataclass(frozen=True)
class RunSettings(Checked):
    """Duration, sample rates and integration of a run."""

    t_end: float = quantity("s", POSITIVE, doc="longest duration of the run, from the release")
    after_latch: float | None = quantity(
        "s",
        NOT_NEGATIVE,
        default=None,
        doc="duration of the run after the latch closes; null: until t_end",
    )
    state_rate: float = quantity(
        "Hz", Range(1.0, 1e6), default=1000.0, doc="sample rate of the full state (BenchState)"
    )
    rate: float = quantity(
        "Hz", Range(0.1, 1e6), default=100.0, doc="sample rate of all other streams"
    )
    rtol: float = quantity(
        "1",
        Range(MIN_RTOL, 1e-2),
        default=1e-8,
        doc="relative error tolerance of a step, of the scene's own scales",
    )
    method: str = choice(METHODS, default="dop853", doc="integrator")
    trace: bool = field(
        default=False,
        metadata={"doc": "record the contact at the integrator's own steps as well (ContactTrace)"},
    )
    step: float = quantity(
        "s",
        Range(MIN_STEP, 1e-2),
        default=2e-5,
        doc="length of the fixed steps of rk4; unused by the other methods",
    )
    max_steps: int = quantity(
        "1",
        Range(100, 10**12),
        default=5_000_000,
        doc="maximum number of steps, including rejected ones; the run stops there with an error",
    )

    def refined(self, rtol_divisor: float, step_divisor: float) -> RunSettings:
        """Return settings with smaller integration errors, to estimate the error of a run.

        The fixed step of ``rk4`` is divided by ``step_divisor``, the tolerance of another method by
        ``rtol_divisor``; neither falls below its lower limit.  If the limit is less than a factor
        of 2 away, the settings get another integrator instead.
        """
        if self.method == "rk4" and self.step >= 2.0 * MIN_STEP:
            return replace(self, step=max(self.step / step_divisor, MIN_STEP))
        if self.method != "rk4" and self.rtol >= 2.0 * MIN_RTOL:
            return replace(self, rtol=max(self.rtol / rtol_divisor, MIN_RTOL))
        return replace(self, method="dopri5" if self.method == "dop853" else "dop853")


@dataclass(frozen=True)
class Detector(Checked):
    """Criteria of the verdicts captured, rebound, missed and stuck."""

    capture_radius: float = quantity(
        "m", DETECTOR_LENGTH, default=0.005, doc="radius of the capture zone around BE"
    )
    min_dwell: float = quantity(
        "s", NOT_NEGATIVE, default=0.2, doc="time in the capture zone that is a capture"
    )
    max_contact_gap: float = quantity(
        "m",
        DETECTOR_LENGTH,
        default=2e-4,
        doc="gap to a wall below which the tip counts as in contact",
    )
    min_retreat: float = quantity(
        "m",
        DETECTOR_LENGTH,
        default=0.02,
        doc="retreat from the closest approach that is a rebound",
    )
    max_still_speed: float = quantity(
        "m/s",
        POSITIVE,
        default=5e-4,
        doc="tip speed in the cone's frame below which the tip is at rest",
    )
    min_still_time: float = quantity(
        "s", POSITIVE, default=1.0, doc="time at rest outside the capture zone that is 'stuck'"
    )
    max_delay: float = quantity(
        "s",
        Range(0.0, 10.0),
        default=0.25,
        doc="longest wait for later measurements, for the fit of a parabola; unused without noise",
    )
    max_data_gap: float = quantity(
        "s", POSITIVE, default=0.1, doc="gap in the measurements that interrupts a dwell"
    )


@dataclass(frozen=True)
class MotionCapture(Checked):
    """Motion capture of the poses of both vehicles."""

    rate: float = quantity("Hz", Range(0.1, 1e6), default=100.0, doc="sample rate of the poses")
    position_noise: float = quantity(
        "m", NOT_NEGATIVE, default=1e-3, doc="standard deviation of each coordinate"
    )
    heading_noise: float = quantity(
        "rad", NOT_NEGATIVE, default=0.0035, doc="standard deviation of each heading"
    )
    latency: float = quantity(
        "s",
        Range(0.0, 10.0),
        default=0.0,
        doc="time until a controller has the poses; their stamps are right",
    )
    dropout: float = quantity(
        "1", Range(0.0, 1.0, high_open=True), default=0.0, doc="share of frames that are lost"
    )
    offset_x: float = quantity(
        "m", default=0.0, doc="error of the chaser's marker frame, along its x"
    )
    offset_y: float = quantity("m", default=0.0, doc="along its y")
    offset_heading: float = quantity(
        "rad", Range(-math.pi, math.pi), default=0.0, doc="of its heading"
    )


@dataclass(frozen=True)
class LoadCell(Checked):
    """Load cell between the cone and the target."""

    rate: float = quantity(
        "Hz", Range(0.1, 1e6), default=1000.0, doc="sample rate of the load cell"
    )
    bandwidth: float = quantity(
        "Hz", POSITIVE, default=200.0, doc="frequency at which the filter halves the power"
    )
    order: str = choice(
        FILTERS,
        default="second",
        doc="order of the low-pass filter; second is a Butterworth filter",
    )
    force_noise: float = quantity(
        "N",
        NOT_NEGATIVE,
        default=0.0,
        doc="standard deviation of each force component, after the filter",
    )
    torque_noise: float = quantity(
        "N m", NOT_NEGATIVE, default=0.0, doc="standard deviation of the torque, after the filter"
    )


@dataclass(frozen=True)
class Sensors(Checked):
    """Simulated sensors, in addition to the exact state."""

    motion_capture: MotionCapture | None = None
    load_cell: LoadCell | None = None
    seed: int = quantity("1", Range(0, 2**63 - 1), default=0, doc="seed of the noise")


@dataclass(frozen=True)
class Scene(Checked):
    """A bench with all its parts, and the settings of its run.

    It is frozen: load_scene() with changes makes another one.

    Examples
    --------
    >>> from capture_sim import load_scene
    >>> scene = load_scene("tilt_0", {"buffer.k_A": "0.6 N/mm"})
    >>> scene.buffer.k_A, scene.latch is None, round(scene.chaser_total_mass, 2)  # N/m, -, kg
    (600.0, False, 23.15)
    >>> scene.buffer.k_A = 500.0
    Traceback (most recent call last):
    dataclasses.FrozenInstanceError: cannot assign to field 'k_A'
    """

    name: str = field(metadata={"doc": "name of the scene and of its files"})
    title: str = field(metadata={"doc": "one line that describes the scene"})
    chaser: Vehicle
    target: Vehicle
    cylinder: Cylinder
    probe: Probe
    buffer: Buffer
    cone: Cone
    contact: Contact
    friction: Friction
    initial: Initial
    run: RunSettings
    detector: Detector
    supports: Supports | None = None
    rail: Rail | None = None
    string: String | None = None
    latch: Latch | None = None
    stops: Stops | None = None
    sensors: Sensors | None = None
    thrusters: Thrusters | None = None
    gravity: float = quantity("m/s^2", POSITIVE, default=9.80665, doc="acceleration of gravity")
    floor: Floor = Floor()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not _NAME.fullmatch(self.name):
            raise SceneError(
                f"name = {shown(self.name)}: must be 1 to 64 letters (a to z), digits and "
                "_ . -, beginning with neither . nor -"
            )

    @property
    def rest_length(self) -> float:
        """Distance from the hinge to the tip's centre with the buffer at rest, m.

        A preloaded axial spring is not relaxed there: it presses the probe on its seat.
        """
        if self.buffer.rest_length is not None:
            return self.buffer.rest_length
        return self.probe.length + self.probe.tip_radius

    @property
    def outward_stroke(self) -> float | None:
        """Outward stroke at which the probe meets its seat or a stop, m; None if it has neither."""
        if self.buffer.seat_force > 0.0:
            return 0.0
        return None if self.stops is None else self.stops.extension

    @cached_property
    def chaser_total_mass(self) -> float:
        """Mass of the complete chaser, with cylinder and probe, kg."""
        return self.chaser.mass + self.cylinder.mass + self.probe.mass

    @property
    def pull(self) -> tuple[float, float]:
        """Acceleration (x, y) of gravity along the floor, m/s^2; 0 on a level floor."""
        return (
            self.gravity * math.sin(self.floor.tilt_x),
            self.gravity * math.sin(self.floor.tilt_y),
        )

    @cached_property
    def contact_stiffness(self) -> float:
        """Stiffness K of the elastic contact force K delta^p, N/m^p.

        It is ``contact.stiffness``; if that is null, K is computed from both materials by eq. (2)
        of the paper, with p = 1.5.  A scene with ``contact.force_table`` does not use K in its
        walls.
        """
        if self.contact.stiffness is not None:
            return self.contact.stiffness
        return (
            4.0
            * math.sqrt(self.probe.tip_radius)
            / (3.0 * (self.contact.tip.sigma + self.contact.wall.sigma))
        )

    def initial_coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the coordinates q (8,) and their rates v (8,) at the release, in SI units.

        The order is x_S, y_S, theta_S (chaser), theta_P, h (probe), x_T, y_T, theta_T (target).
        """
        c, t = self.initial.chaser, self.initial.target
        q = np.array([c.x, c.y, c.theta, c.theta, self.rest_length, t.x, t.y, t.theta])
        v = np.array([c.vx, c.vy, c.omega, c.omega, 0.0, t.vx, t.vy, t.omega])
        return q, v

    def to_yaml(self) -> str:
        """Return the complete scene as YAML text; loading this text gives an equal scene."""
        return yaml_text(self)

    def plot(self) -> Any:
        """Return a matplotlib figure of the run of this scene; see :func:`capture_sim.plot`.

        Raises
        ------
        MissingPackageError
            matplotlib is not installed.
        """
        return drawn(self)

    def _repr_html_(self) -> str:
        """Return the scene for a notebook: the values of each part, in SI units."""
        rows = ((name, str(value)) for name, value in _values(as_mapping(self)))
        return html_table(f"{self.name}: {self.title}", rows)


def _values(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in mapping.items():
        if isinstance(value, dict):
            yield from _values(value, f"{prefix}{name}.")
        elif prefix:
            yield f"{prefix}{name}", value


#: Pattern of scene names, which recordings, plots and paths in the viewer contain.
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")


def as_name(text: str) -> str:
    """Return a text as a valid scene name of at most 64 characters.

    Characters other than letters (a to z), digits and ``_ . -`` become ``_``.  A text that is empty
    or begins with ``.`` or ``-`` gets ``run_`` before it.
    """
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", text)[:64]
    return name if _NAME.fullmatch(name) else f"run_{name}"[:64]


def as_mapping(part: Any) -> Any:
    """Return a scene or a part as nested dictionaries by field name, with lists for tuples."""
    if is_dataclass(part) and not isinstance(part, type):
        return {f.name: as_mapping(getattr(part, f.name)) for f in fields(part)}
    if isinstance(part, tuple):
        return [as_mapping(item) for item in part]
    return part
