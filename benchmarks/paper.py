"""The paper's sections 5 and 6: what it says, what comes out here, by how much they differ, why.

What the paper leaves open is varied, one assumption at a time and all together, to see how far
its verdicts depend on it.  Its Figures 10 and 11 set velocities beside SimMechanics; here they
stand beside Exudyn, whose run is stored in config/reference with its source.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from capture_sim.base.resources import config_dir
from capture_sim.run.first_contact import first_cluster
from capture_sim.run.run import Run
from capture_sim.run.simulation import simulate
from capture_sim.scene.approach import Approach, placed
from capture_sim.scene.launch_plan import travel_to_touch
from capture_sim.scene.laws import CONTACT_LAWS
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import changed
from capture_sim.studies.evaluate.executors import answers
from capture_sim.studies.evaluate.outcome import Outcome, run_first_contact, run_to_verdict
from capture_sim.studies.search.paper_flow import FirstContactTarget, design_first_contact

#: The cases with a verdict in the paper: whether it says captured.
CASES = {
    "paper_undamped": False,
    "paper_designed": True,
    "paper_case_1": False,
    "paper_case_2": False,
    "paper_case_3": True,
}
#: The docking of Figure 12: the designed case from one metre away.
DOCKING = "docking"
#: Duration of the undamped first contact in the paper (Figure 7), s.
FIRST_CONTACT = 0.2734
#: Restitutions at which it is measured here.
RESTITUTIONS = (0.2, 0.4, 0.5)
#: How the damping of a touch follows from its speed, by name: overrides of the scene.
DAMPING = {
    "by the touch's first approach (the model's)": (),
    "by the first approach, with the factor that returns e exactly": ("contact.law=exact",),
    "without memory: by the first impact, for every touch": ("contact.min_approach_speed=0.1",),
}

_SPEED = 0.1  # m/s
_RUN_UP = 1e-4  # m, 1 ms before the touch
_B = 0.045  # m, from BE to the first touch, Table 2
_RTOL = 1e-6


def scene_of(name: str, overrides: Sequence[str] = ()) -> Scene:
    """Return one of the paper's scenes, the docking of Figure 12 among them."""
    if name != DOCKING:
        return load_scene(name, overrides)
    scene = load_scene("paper_designed", ["run.t_end=12", *overrides])
    x = scene.initial.target.x + 1.0 - travel_to_touch(scene)
    far = changed(scene, "initial.target.x", x)
    return replace(far, name=DOCKING, title="Paper, docking from 1 m away (Figure 12)")


# what the paper leaves open


@dataclass(frozen=True)
class Assumption:
    """Something that the paper leaves open, or states in a way that can be read otherwise.

    Attributes
    ----------
    name, unit, factor
        As displayed; ``factor`` from SI to ``unit``.
    field
        What of the scene it is; ``"b"`` is the distance of the first touch from BE.
    values
        That are tried, SI.
    stated
        What the paper says of it.
    assumed
        The value taken in the scenes.
    """

    name: str
    field: str
    unit: str
    factor: float
    values: tuple[float | str, ...]
    stated: str
    assumed: float | str

    @property
    def tried(self) -> str:
        """What is tried, in words."""
        if isinstance(self.values[0], str):
            laws = [value for value in self.values if value != "none"]
            return f"{len(laws)} laws" + (" and none" if "none" in self.values else "")
        low, high = (float(end(self.values)) * self.factor for end in (min, max))
        return f"{low:.4g} to {high:.4g} {self.unit}".rstrip()


def _even(low: float, high: float, count: int) -> tuple[float, ...]:
    return tuple(np.linspace(low, high, count).tolist())


_V_EPS = tuple(np.geomspace(1e-4, 1e-2, 13).tolist())
_H_0 = (0.1365, *_even(0.15, 0.24, 19))
_FRICTION = ("tanh", "clamp", "brown_mcphee", "coulomb", "none")

ASSUMPTIONS = (
    Assumption("restitution e", "contact.restitution", "", 1, _even(0, 0.95, 20), "not given", 0.5),
    Assumption(
        "slip of full friction v_eps",
        "friction.slip_regularization_speed",
        "mm/s",
        1e3,
        _V_EPS,
        "not given",
        1e-3,
    ),
    Assumption("friction mu", "friction.mu", "", 1, _even(0, 0.6, 25), "0.33", 0.33),
    Assumption(
        "radius of capture",
        "detector.capture_radius",
        "mm",
        1e3,
        _even(1e-3, 15e-3, 15),
        "'zero'",
        5e-3,
    ),
    Assumption("dwell", "detector.min_dwell", "s", 1, _even(0, 1, 11), "not given", 0.2),
    Assumption(
        "rest length h_0",
        "buffer.rest_length",
        "mm",
        1e3,
        _H_0,
        "l_0 = 136.5 mm, of the spring",
        0.215,
    ),
    Assumption("first touch b", "b", "mm", 1e3, _even(0.02, 0.07, 21), "45 mm", _B),
    Assumption(
        "mass of the chaser's body",
        "chaser.mass",
        "kg",
        1,
        (20.792415, 21.9706),
        "21.9706 kg, with cylinder and probe or without",
        21.9706,
    ),
    Assumption("torsional damping c_T", "buffer.c_T", "N m s/rad", 1, _even(0, 2, 11), "none", 0.0),
    Assumption(
        "friction law", "friction.law", "", 1, _FRICTION, "mu F_n in a fixed direction", "tanh"
    ),
    Assumption(
        "contact law", "contact.law", "", 1, CONTACT_LAWS, "Lankarani-Nikravesh", CONTACT_LAWS[0]
    ),
)

#: What the paper does not state at all: field, range, and whether its logarithm is varied evenly.
OPEN = (
    ("contact.restitution", 0.0, 0.95, False),
    ("friction.slip_regularization_speed", 1e-4, 1e-2, True),
    ("detector.capture_radius", 1e-3, 12e-3, True),
    ("detector.min_dwell", 0.0, 0.5, False),
    ("buffer.rest_length", 0.19, 0.225, False),
    ("chaser.mass", 20.792415, 21.9706, False),
)


@cache
def _far_scene(case: str) -> Scene:
    """Return a case with the target so far off that no assumption puts the tip into the cone."""
    return load_scene(case, ["initial.target.x=2.0"])


def run_case(task: tuple[str, tuple[tuple[str, float | str], ...]]) -> Outcome:
    """Run a case with fields changed, approached as the paper does, until its verdict."""
    case, values = task
    b, scene = _B, _far_scene(case)
    for field, value in values:
        if field == "b":
            b = float(value)
        else:
            scene = changed(scene, field, value)
    cone, tip = scene.cone, scene.probe.tip_radius
    lateral_offset = cone.R_c + b * math.sin(cone.half_angle) - tip * math.cos(cone.half_angle)
    near = placed(scene, Approach(0.0, -lateral_offset, _SPEED), _RUN_UP)
    return run_to_verdict(changed(near, "run.rtol", _RTOL))


@dataclass(frozen=True)
class Scan:
    """An assumption varied alone: ``points[case]`` in the order of its values."""

    assumption: Assumption
    points: dict[str, list[Outcome]]

    def agrees(self, case: str) -> list[bool]:
        """Return for each value whether the verdict is the paper's."""
        return [point.captured == CASES[case] for point in self.points[case]]

    def where(self, case: str) -> str:
        """Return in words for which values the verdict is the paper's."""
        agrees, of = self.agrees(case), self.assumption
        if all(agrees) or not any(agrees):
            return "all" if all(agrees) else "none"
        pairs = list(zip(of.values, agrees, strict=True))
        if isinstance(of.values[0], str):
            return ", ".join(str(value) for value, good in pairs if good)
        pieces = []
        for good, group in itertools.groupby(pairs, key=lambda pair: pair[1]):
            ends = [f"{float(value) * of.factor:.4g}" for value, _ in group]
            if good:
                pieces.append(ends[0] if len(ends) == 1 else f"{ends[0]} to {ends[-1]}")
        return f"{', '.join(pieces)} {of.unit}".rstrip()


@dataclass(frozen=True)
class JointVariation:
    """All that is open varied together: ``agrees[case]`` (n,) in the order of the samples."""

    agrees: dict[str, np.ndarray]

    @property
    def count(self) -> int:
        """How many samples."""
        return len(next(iter(self.agrees.values())))

    def share(self, *cases: str) -> float:
        """Return in which part of the samples all these verdicts are the paper's."""
        return float(np.mean(np.all([self.agrees[case] for case in cases], axis=0)))


def scan_assumptions(
    executor: Executor, assumptions: Sequence[Assumption] = ASSUMPTIONS
) -> list[Scan]:
    """Vary each assumption alone, in every case."""
    tasks = [(c, ((a.field, value),)) for a in assumptions for c in CASES for value in a.values]
    points = answers(executor, run_case, tasks)
    return [Scan(a, {c: [next(points) for _ in a.values] for c in CASES}) for a in assumptions]


def vary_together(executor: Executor, count: int = 192, seed: int = 1) -> JointVariation:
    """Vary all that is open together, by a Latin hypercube of ``count`` samples."""
    fields, low, high, by_log = zip(*OPEN, strict=True)
    # `seed`: what SciPy 1.11 calls `rng`
    unit = qmc.LatinHypercube(len(OPEN), seed=np.random.default_rng(seed)).random(count)
    ends = [np.where(by_log, np.log(np.maximum(end, 1e-300)), end) for end in (low, high)]
    values = ends[0] + unit * (ends[1] - ends[0])
    values = np.where(by_log, np.exp(values), values)
    samples = [tuple(zip(fields, row, strict=True)) for row in values.tolist()]
    points = answers(executor, run_case, [(c, s) for c in CASES for s in samples])
    return JointVariation(
        {c: np.array([next(points).captured == says for _ in samples]) for c, says in CASES.items()}
    )


# the second engine


@dataclass(frozen=True)
class SecondEngine:
    """The designed case in another engine beside ours, friction clamped at v_eps in both.

    Attributes
    ----------
    source
        Engine, version and settings.
    t, v, h : ndarray (n,), (n, 8), (n,)
        Its times, s, rates, m/s and rad/s, and length of the buffer, m.
    ours : Run
        At the same times.
    difference, law_effect : ndarray (8,)
        Largest difference of each rate to the end of the first contact: between the engines,
        and of ours between friction clamped and as tanh.
    """

    source: str
    t: np.ndarray
    v: np.ndarray
    h: np.ndarray
    ours: Run
    difference: np.ndarray
    law_effect: np.ndarray


def second_engine() -> SecondEngine:
    """Run the designed case at the times of the stored run of Exudyn, and compare."""
    path = config_dir() / "reference" / "paper_designed_exudyn.csv"
    with path.open(encoding="utf-8") as file:
        source = file.readline().lstrip("# ").rstrip()
    table = np.loadtxt(path, delimiter=",")
    t, v = table[:, 0], table[:, 1:9]
    clamped, smooth = (
        simulate(
            load_scene("paper_designed", [f"friction.law={law}"]),
            t_end=float(t[-1]),
            t_eval=t,
            rtol=1e-10,
        )
        for law in ("clamp", "tanh")
    )
    until = t <= first_cluster(clamped.touches)["end"].max()
    differences = [np.abs(clamped.v - other)[until].max(axis=0) for other in (v, smooth.v)]
    return SecondEngine(source, t, v, table[:, 9], clamped, *differences)


# the evidence, and the statements that are compared with it


class Evidence:
    """The runs and studies that statements and figures are made from, each made once, when needed.

    Parameters
    ----------
    executor
        Where the assumptions are varied.

    Attributes
    ----------
    run : callable
        Returns one of the paper's cases by its name, run to its end.
    """

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self.run = cache(lambda name: simulate(scene_of(name)))

    @cached_property
    def engine(self) -> SecondEngine:
        """The second engine."""
        return second_engine()

    @cached_property
    def scans(self) -> list[Scan]:
        """Assumptions varied one by one."""
        return scan_assumptions(self._executor)

    @cached_property
    def joint_variation(self) -> JointVariation:
        """Everything open varied together."""
        return vary_together(self._executor)

    @cached_property
    def damping(self) -> dict[tuple[str, str], Run]:
        """Every case with each damping of a touch, by both names."""
        return {
            (case, how): simulate(scene_of(case, overrides))
            for case in CASES
            for how, overrides in DAMPING.items()
        }


class Agreement(StrEnum):
    """How far a statement of the paper agrees with the result here."""

    NUMBERS = "agrees in numbers"
    SHAPE = "agrees in shape"  # in a verdict or an order of events, of which no number is given
    NOT_COMPARABLE = "cannot be compared"
    DIFFERS = "differs"


def _or_differs(agrees: bool, kind: Agreement = Agreement.SHAPE) -> Agreement:
    return kind if agrees else Agreement.DIFFERS


class Claim(NamedTuple):
    """A statement of the paper, the result here, and how far they agree."""

    where: str
    paper: str
    here: str
    difference: str
    why: str
    agreement: Agreement


def claims(evidence: Evidence) -> Iterator[Claim]:
    """Yield every statement, in the paper's order."""
    yield from impact(evidence.run("paper_clamped"), evidence.run("paper_undamped"))
    designed = evidence.run("paper_designed")
    yield _verdict(designed, "Fig. 8", "captured", True)
    yield _tends_to_zero(designed)
    yield from design_flow()
    yield from velocities(evidence.engine)
    yield from docking(evidence.run(DOCKING))
    radius = next(s for s in evidence.scans if s.assumption.field == "detector.capture_radius")
    both = evidence.joint_variation.share("paper_designed", "paper_case_2")
    count = evidence.joint_variation.count
    why_2 = (
        "comes closer than the designed buffer: agrees for a radius of capture of "
        f"{radius.where('paper_case_2')} only, where the designed one is not captured either; both "
        f"agree in {round(both * count)} of {count} samples of all open assumptions"
    )
    why_3 = (
        f"turns back short of BE: agrees for a radius of capture of {radius.where('paper_case_3')}"
    )
    chosen = "masses, balls, rail and latch are chosen here, as the paper gives none"
    for name, where, says, captured, why in (
        ("paper_case_1", "Fig. 13", "rebounds, not captured", False, ""),
        ("paper_case_2", "Fig. 13", "not captured: too much energy dissipated", False, why_2),
        ("paper_case_3", "Fig. 13", "captured", True, why_3),
        ("tilt_0", "Fig. 15", "relative attitude 0 deg: captured", True, chosen),
        ("tilt_p10", "Fig. 16", "relative attitude +10 deg: captured", True, chosen),
        ("tilt_m10", "Fig. 17", "relative attitude -10 deg: captured", True, chosen),
    ):
        yield _verdict(evidence.run(name), where, says, captured, why)


def _verdict(run: Run, where: str, says: str, captured: bool, why: str = "") -> Claim:
    agrees = _or_differs((run.verdict == "captured") == captured)
    here = f"{run.verdict}; closest approach {run.summary['nearest_distance'] * 1e3:.2f} mm"
    return Claim(where, f"{run.scene.name}: {says}", here, "", why, agrees)


def _tends_to_zero(run: Run) -> Claim:
    """Figure 8: the distance after the closest approach."""
    distance = run.samples["tip_distance"]
    farthest = float(distance[int(distance.argmin()) :].max())
    here = f"{distance.min() * 1e3:.2f} mm, then up to {farthest * 1e3:.1f} mm"
    why = "nearly at rest there, then drifts out slowly: in the text no latch holds the tip"
    agrees = _or_differs(farthest <= run.scene.detector.capture_radius)
    return Claim("Fig. 8", f"{run.scene.name}: the distance tends to 0", here, "", why, agrees)


def impact(clamped: Run, undamped: Run) -> Iterator[Claim]:
    """Figures 5 to 7: the clamped probe, and the buffer without damper."""
    (force, lasts), (soft_force, soft_lasts) = (
        (run.summary["first_contact_peak_force"], run.summary["first_contact_duration"])
        for run in (clamped, undamped)
    )
    says = "clamped probe: high, short force (a curve, no numbers in the text)"
    here = f"{force:.0f} N over {lasts * 1e3:.1f} ms"
    yield Claim("Fig. 5", says, here, "-", "no number in the text", Agreement.NOT_COMPARABLE)
    says = "the buffer considerably reduces the impact force"
    here = f"{soft_force:.0f} N: {force / soft_force:.2f} times less"
    why = "the buffer decouples the tip's own mass, so only its first touch remains"
    yield Claim("Fig. 5, 6", says, here, "", why, _or_differs(force / soft_force >= 2.0))
    says = "and remarkably increases the contact time"
    here = f"{soft_lasts * 1e3:.1f} ms: {soft_lasts / lasts:.1f} times longer"
    why = "vehicles on the axial spring instead of on the probe's own stiffness"
    yield Claim("Fig. 5, 6", says, here, "", why, _or_differs(soft_lasts / lasts >= 20.0))
    scenes = {e: scene_of("paper_undamped", [f"contact.restitution={e}"]) for e in RESTITUTIONS}
    durations = {e: run_first_contact(scene).duration for e, scene in scenes.items()}
    best = min(durations, key=lambda e: abs(durations[e] - FIRST_CONTACT))
    measured = ", ".join(f"{t * 1e3:.1f} ms at e = {e:g}" for e, t in durations.items())
    off = soft_lasts / FIRST_CONTACT - 1.0
    says, here = f"first contact lasts {FIRST_CONTACT} s", f"{soft_lasts:.4f} s (e = 0.5)"
    why = f"e is not given; {measured}: best at e = {best:g}"
    agrees = _or_differs(abs(off) <= 0.005, Agreement.NUMBERS)
    yield Claim("Fig. 6, 7", says, here, f"{off:+.2%}", why, agrees)
    first = first_cluster(undamped.touches)
    end = first["end"].max()
    later = undamped.touches[undamped.touches["start"] > end]
    other, here = False, "no second hit"
    if later.size:
        other = bool(later["wall"][0] != first["wall"][0])
        wall = "the other" if other else "the same"
        here = f"next touch on {wall} wall, {(later['start'][0] - end) * 1e3:.0f} ms later"
    says = "then the tip rebounds, and hits the cone again on its upper wall"
    yield Claim("Fig. 7", says, here, "", "", _or_differs(other))
    yield _verdict(undamped, "Fig. 6, 7", "not captured", False)


def design_flow() -> Iterator[Claim]:
    """Section 4, from the strokes that the paper's springs give."""
    scene = load_scene("paper_undamped")
    own = run_first_contact(scene)
    design = design_first_contact(scene, FirstContactTarget(own.axial_stroke, own.torsion))
    assert design.scene is not None
    assert design.capturing is not None
    low, high = design.capturing
    says = "c_A = 13 N s/m is a proper value; more and less fail"
    here = f"c_A from {low:.1f} to {high:.1f} N s/m captures, less and more do not"
    yield Claim(
        "section 4",
        says,
        here,
        "",
        "with the springs for the strokes of (500, 200); 13 lies near the lower end",
        _or_differs(low <= 13.0 <= high),
    )


def velocities(engine: SecondEngine) -> Iterator[Claim]:
    """Figures 10 and 11."""
    says = "velocities and buffer agree with SimMechanics (curves)"
    off, law = engine.difference, engine.law_effect
    places, angles, vehicles = [0, 1, 5, 6], [2, 7], [0, 1, 2, 5, 6, 7]
    yield Claim(
        "Fig. 10",
        says,
        "Exudyn, to the end of the first contact: chaser and target within "
        f"{off[places].max():.1e} m/s and {off[angles].max():.1e} rad/s",
        f"{off[vehicles].max():.0e}",
        "the paper's program is SimMechanics, and its curves have no numbers; both here with "
        "friction clamped at v_eps; tanh instead moves the vehicles' rates by up to "
        f"{law[places].max():.0e} m/s and {law[angles].max():.0e} rad/s",
        Agreement.NOT_COMPARABLE,
    )
    here = f"stroke rate within {off[4]:.1e} m/s, probe within {off[3]:.1e} rad/s"
    why = "as above; the probe is the lightest part, so each touch affects it most"
    largest = off[3:5].max()
    yield Claim("Fig. 11", says, here, f"{largest:.0e}", why, Agreement.NOT_COMPARABLE)


def docking(run: Run) -> Iterator[Claim]:
    """Figure 12."""
    yield _verdict(run, "Fig. 12", "the tip slides into the capture area", True)
