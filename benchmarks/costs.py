"""What things cost: parts of a scene, one evaluation, simulated time, touches, batches."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from benchmarks.engines.own import packed, with_run
from benchmarks.engines.scipy_ivp import gap_of_wall
from benchmarks.pages import Spread
from benchmarks.trial import Progress, timed
from capture_sim.base.compiled.kernels import entry_kernel
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.model.equations import N_TOTAL, make_system, rate_of_change
from capture_sim.dynamics.samples import EventKind
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Scene

_SUPPORT = "{balls: [[0.12, 0.0], [-0.06, 0.104], [-0.06, -0.104]], c_rr: 1.0e-3}"
_NO_FRICTION = ["friction.law=none"]
_PAPER = ["friction.law=tanh"]
#: What a part costs: the scene with it, and the scene that it is compared with, by what changes.
PARTS: dict[str, tuple[list[str], list[str]]] = {
    "axial damper": (_NO_FRICTION, ["buffer.c_A=0", *_NO_FRICTION]),
    "torsional damper": (["buffer.c_T=0.2", *_NO_FRICTION], _NO_FRICTION),
    "friction tanh, compared with none": (_PAPER, _NO_FRICTION),
    **{
        f"friction {law}, compared with tanh": ([f"friction.law={law}"], _PAPER)
        for law in ("clamp", "brown_mcphee", "coulomb")
    },
    "stroke stops, never met": (
        [*_PAPER, "stops={compression: 0.1, extension: 0.1, stiffness: 1.0e+5, damping: 0}"],
        _PAPER,
    ),
    "latch, never closed": (
        [*_PAPER, "latch={radius: 1.0e-5, stiffness: 2.0e+4, damping: 80}"],
        _PAPER,
    ),
    "ball supports": ([*_PAPER, f"supports={{chaser: {_SUPPORT}, target: {_SUPPORT}}}"], _PAPER),
}
_LOOP = 20_000  # evaluations in one measurement of an evaluation


@entry_kernel
def evaluate_often(systems, y, f, n):
    """Evaluate the equations of motion ``n`` times, each waiting for the one before."""
    for _ in range(n):
        rate_of_change(0.0, y, f, systems[0])
        y[0] += 1e-18 * f[8]


@dataclass(frozen=True)
class RunCost:
    """What a run costs that ends at ``t_end`` (s)."""

    t_end: float
    touches: int
    evaluations: int
    seconds: Spread  # CPU time


class Difference(NamedTuple):
    """How much longer one thing takes than another, measured in pairs, s."""

    median: float
    low: float  # 95 % interval of the median
    high: float

    @classmethod
    def of(cls, differences: Sequence[float]) -> Difference:
        """Return the median of differences with its interval, from their order alone."""
        ordered, n = sorted(differences), len(differences)
        outside = int(max((n - 1.96 * math.sqrt(n)) / 2.0, 0.0))
        return cls(statistics.median(ordered), ordered[outside], ordered[n - 1 - outside])

    @property
    def is_told_from_zero(self) -> bool:
        """Return True if the interval does not contain zero."""
        return not self.low <= 0.0 <= self.high


@dataclass(frozen=True)
class PartCost:
    """What a part of a scene costs; of pairs of numbers the first is with it."""

    name: str
    touches: tuple[int, int]
    evaluations: tuple[int, int]
    run: Difference  # CPU time
    free: Difference  # of one evaluation in free flight
    contact: Difference  # ... and in contact


@dataclass(frozen=True)
class BatchCost:
    """What ``runs`` runs of as many different scenes cost."""

    runs: int
    seconds: Spread  # CPU time, all in all
    preparing: float  # share of it before the integration


def in_pairs(job: Callable[[], float], other: Callable[[], float], pairs: int) -> Difference:
    """Return by how many seconds a job exceeds another.

    They alternate, each first in every other pair: what slows the machine slows both.
    """
    differences = []
    for number in range(pairs + 1):
        if number % 2:
            with_part, without = job(), other()
        else:
            without, with_part = other(), job()
        if number:  # the first pair fills the processor's caches
            differences.append(with_part - without)
    return Difference.of(differences)


def evaluation(scene: Scene, touching: bool) -> Callable[[], float]:
    """Return what measures one evaluation, s, free or in contact 3 um deep in the -y wall."""
    parameters = packed(scene)
    system = make_system(parameters)
    y = np.concatenate([*scene.initial_coordinates(), np.zeros(N_TOTAL - 16)])
    if touching:
        touch = system["mode"]["touch"][0, 1]
        touch["on"], touch["chi"], touch["direction"] = 1, 1e9, 1.0
        for _ in range(20):
            y[0] += (gap_of_wall(parameters, y, -1.0)[0] + 3e-6) / np.sin(scene.cone.half_angle)
    f = np.zeros(N_TOTAL)

    def measured() -> float:
        began = time.thread_time()
        evaluate_often(system, y, f, _LOOP)
        return (time.thread_time() - began) / _LOOP

    return measured


def integration(scene: Scene, t_end: float) -> Callable[[], float]:
    """Return what measures a run to ``t_end`` (s), s, without setting it up."""
    scene, times = with_run(scene, t_end=t_end), np.array([t_end])

    def measured() -> float:
        warm, bench = Bench(scene), Bench(scene)
        return timed(lambda: bench.advance(times), lambda: warm.advance(times))[0]

    return measured


def run_cost(scene: Scene, t_end: float, repeats: int) -> RunCost:
    """Measure a run to ``t_end`` (s)."""
    touches, evaluations = _counts(scene, t_end)
    measured = integration(scene, t_end)
    seconds = Spread.of([measured() for _ in range(repeats)])
    return RunCost(t_end, touches, evaluations, seconds)


def _counts(scene: Scene, t_end: float) -> tuple[int, int]:
    """Return how many touches and evaluations a run to ``t_end`` (s) has."""
    bench = Bench(with_run(scene, t_end=t_end))
    bench.advance(np.array([t_end]))
    return bench.touches.size, bench.statistics.evaluations


def part_costs(
    name: str, t_end: float, quick: bool, pairs: int, progress: Progress
) -> list[PartCost]:
    """Measure what the parts of a scene cost; quick: some of them."""
    rows, cases = [], list(PARTS.items())[: 2 if quick else None]
    for number, (part, (changes, base)) in enumerate(cases):
        progress.at("cost of parts", number, len(cases), part)
        scenes = load_scene(name, changes), load_scene(name, base)
        counts = [_counts(scene, t_end) for scene in scenes]
        run = in_pairs(*(integration(scene, t_end) for scene in scenes), pairs=pairs)
        free, contact = (
            in_pairs(*(evaluation(scene, touching) for scene in scenes), pairs=pairs)
            for touching in (False, True)
        )
        touches, evaluations = zip(*counts, strict=True)
        rows.append(PartCost(part, touches, evaluations, run, free, contact))
    return rows


def rail_cost(scene: Scene, repeats: int) -> RunCost:
    """Measure a scene with rail and string from the release to the rail's end."""
    bench = Bench(scene)
    bench.advance(np.zeros(0))
    end = next(event.t for event in bench.events if event.kind is EventKind.RAIL_END)
    return run_cost(scene, 0.999 * end, repeats)


def batch_cost(scene: Scene, t_end: float, size: int, repeats: int) -> BatchCost:
    """Measure runs that differ in the speed of the approach, one after the other."""
    scene, times = with_run(scene, t_end=t_end), np.array([t_end])
    totals, shares = [], []
    for _ in range(repeats):
        preparing = running = 0.0
        for vx in np.linspace(0.05, 0.15, size).tolist():
            began = time.thread_time()
            chaser = dataclasses.replace(scene.initial.chaser, vx=vx)
            initial = dataclasses.replace(scene.initial, chaser=chaser)
            bench = Bench(dataclasses.replace(scene, initial=initial))
            ready = time.thread_time()
            bench.advance(times)
            preparing += ready - began
            running += time.thread_time() - ready
        totals.append(preparing + running)
        shares.append(preparing / totals[-1])
    return BatchCost(size, Spread.of(totals), statistics.median(shares))
