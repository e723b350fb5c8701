"""What the paper leaves open, and how far its verdicts hang on it.

Each reading is varied on its own, in every case of the paper with the damper or without; then
all that is not stated is varied together, to see whether any reading gives every verdict.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from capture_sim.detection.exact import CaptureState
from capture_sim.scene.files import load_scene
from capture_sim.scene.parts import CONTACT_LAWS, Scene
from capture_sim.studies.approach import placed
from capture_sim.studies.executors import Executor, ordered
from capture_sim.studies.verdict import run_to_verdict

#: The cases with a verdict in the paper: whether it says captured.
CASES = {
    "paper_undamped": False,
    "paper_designed": True,
    "paper_case_1": False,
    "paper_case_2": False,
    "paper_case_3": True,
}

_RTOL = 1e-6
_SPEED = 0.1  # m/s
_RUN_UP = 1e-4  # m, 1 ms before the touch
_B = 0.045  # m, from BE to the first touch, Table 2


@dataclass(frozen=True)
class Reading:
    """Something open to reading.

    ``values`` are taken in turn; ``field`` is what of the scene they are, or ``"b"``, the
    place of the first touch.  ``stated`` says what the paper says of it, ``taken`` which value
    is taken here.
    """

    name: str
    field: str
    unit: str
    factor: float  # from SI to the unit shown
    values: tuple[float | str, ...]
    stated: str
    taken: float | str


def _grid(low: float, high: float, count: int) -> tuple[float, ...]:
    return tuple(np.linspace(low, high, count).tolist())


def _log_grid(low: float, high: float, count: int) -> tuple[float, ...]:
    return tuple(np.geomspace(low, high, count).tolist())


READINGS = (
    Reading(
        "restitution e", "contact.restitution", "", 1.0, _grid(0.0, 0.95, 20), "not given", 0.5
    ),
    Reading(
        "slip of full friction v_eps",
        "friction.v_eps",
        "mm/s",
        1e3,
        _log_grid(1e-4, 1e-2, 13),
        "not given",
        1e-3,
    ),
    Reading("friction mu", "friction.mu", "", 1.0, _grid(0.0, 0.6, 25), "0.33", 0.33),
    Reading(
        "radius of capture", "detector.radius", "mm", 1e3, _grid(1e-3, 15e-3, 15), "'zero'", 5e-3
    ),
    Reading("dwell", "detector.dwell", "s", 1.0, _grid(0.0, 1.0, 11), "not given", 0.2),
    Reading(
        "rest length h_0",
        "buffer.rest_length",
        "mm",
        1e3,
        (0.1365, *_grid(0.15, 0.24, 19)),
        "l_0 = 136.5 mm, of the spring",
        0.215,
    ),
    Reading("first touch b", "b", "mm", 1e3, _grid(0.02, 0.07, 21), "45 mm", _B),
    Reading(
        "mass of the chaser's body",
        "chaser.mass",
        "kg",
        1.0,
        (20.792415, 21.9706),
        "21.9706 kg, with cylinder and probe or without",
        21.9706,
    ),
    Reading(
        "torsional damping c_T", "buffer.c_T", "N m s/rad", 1.0, _grid(0.0, 2.0, 11), "none", 0.0
    ),
    Reading(
        "friction law",
        "friction.law",
        "",
        1.0,
        ("tanh", "clamp", "coulomb", "none"),
        "mu F_n in a fixed direction",
        "tanh",
    ),
    Reading(
        "contact law",
        "contact.law",
        "",
        1.0,
        CONTACT_LAWS,
        "Lankarani-Nikravesh",
        "lankarani_nikravesh",
    ),
)

#: What the paper does not state: field, range, and whether it is varied by its logarithm.
OPEN = (
    ("contact.restitution", 0.0, 0.95, False),
    ("friction.v_eps", 1e-4, 1e-2, True),
    ("detector.radius", 1e-3, 12e-3, True),
    ("detector.dwell", 0.0, 0.5, False),
    ("buffer.rest_length", 0.19, 0.225, False),
    ("chaser.mass", 20.792415, 21.9706, False),
)


class Point(NamedTuple):
    """One run: what was read how, and what came of it."""

    case: str
    captured: bool
    verdict: str
    nearest: float


@cache
def _far_scene(case: str) -> Scene:
    """Return a case with the target so far off that no reading puts the tip into the cone."""
    return load_scene(case, ["initial.target.x=2.0"])


def judge(task: tuple[str, tuple[tuple[str, float | str], ...]]) -> Point:
    """Run a case with some of its values read otherwise."""
    case, values = task
    b, scene = _B, _far_scene(case)
    for field, value in values:
        part, _, name = field.rpartition(".")
        if part:
            scene = replace(scene, **{part: replace(getattr(scene, part), **{name: value})})
        else:
            b = float(value)
    cone, tip = scene.cone, scene.probe.tip_radius
    beside = cone.R_c + b * math.sin(cone.beta) - tip * math.cos(cone.beta)
    near = placed(scene, 0.0, -beside, _SPEED, _RUN_UP)
    assert near is not None
    outcome = run_to_verdict(near, rtol=_RTOL)
    return Point(case, outcome.captured, CaptureState(outcome.verdict).label, outcome.nearest)


@dataclass(frozen=True)
class Scan:
    """A reading varied on its own: ``points[case]`` goes along its values."""

    reading: Reading
    points: dict[str, list[Point]]

    def agrees(self, case: str) -> list[bool]:
        """Return for each value whether the verdict is the paper's."""
        return [point.captured == CASES[case] for point in self.points[case]]

    def where(self, case: str) -> str:
        """Say for which values the verdict is the paper's."""
        agrees = self.agrees(case)
        if all(agrees):
            return "all"
        if not any(agrees):
            return "none"
        reading = self.reading
        if isinstance(reading.values[0], str):
            return ", ".join(str(v) for v, a in zip(reading.values, agrees, strict=True) if a)
        pieces = []
        for good, group in itertools.groupby(
            zip(reading.values, agrees, strict=True), key=lambda pair: pair[1]
        ):
            if good:
                ends = [f"{float(v) * reading.factor:.4g}" for v, _ in group]
                pieces.append(ends[0] if len(ends) == 1 else f"{ends[0]} to {ends[-1]}")
        return ", ".join(pieces) + (f" {reading.unit}" if reading.unit else "")


@dataclass(frozen=True)
class Together:
    """All that is open varied together: ``agrees[case]`` goes along the samples."""

    agrees: dict[str, np.ndarray]

    @property
    def count(self) -> int:
        """How many samples."""
        return len(next(iter(self.agrees.values())))

    def share(self, *cases: str) -> float:
        """Return in which part of the samples all these verdicts are the paper's."""
        return float(np.mean(np.all([self.agrees[case] for case in cases], axis=0)))


def scan_readings(executor: Executor, readings: Sequence[Reading] = READINGS) -> list[Scan]:
    """Vary each reading on its own, in every case."""
    tasks = [
        (case, ((reading.field, value),))
        for reading in readings
        for case in CASES
        for value in reading.values
    ]
    points = iter(ordered(executor, judge, tasks))
    return [
        Scan(reading, {case: [next(points) for _ in reading.values] for case in CASES})
        for reading in readings
    ]


def vary_together(executor: Executor, count: int = 192, seed: int = 1) -> Together:
    """Vary all that is open together, by a Latin hypercube of ``count`` samples."""
    # `seed`: what SciPy 1.11 calls `rng`
    unit = qmc.LatinHypercube(len(OPEN), seed=np.random.default_rng(seed)).random(count)
    samples = []
    for row in unit.tolist():
        values = [
            low * (high / low) ** share if log else low + share * (high - low)
            for share, (_, low, high, log) in zip(row, OPEN, strict=True)
        ]
        fields = (field for field, *_ in OPEN)
        samples.append(tuple(zip(fields, values, strict=True)))
    tasks = [(case, sample) for case in CASES for sample in samples]
    points = ordered(executor, judge, tasks)
    agrees = {}
    for number, case in enumerate(CASES):
        mine = points[number * count : (number + 1) * count]
        agrees[case] = np.array([point.captured == CASES[case] for point in mine])
    return Together(agrees)
