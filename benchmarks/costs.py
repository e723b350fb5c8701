"""What things cost: parts of a scene, one evaluation, simulated time, touches, batches."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from dataclasses import dataclass

import numpy as np

from benchmarks.engines.own import packed, with_run
from benchmarks.engines.scipy_ivp import gap_of_wall
from benchmarks.pages import Spread
from benchmarks.trial import Progress, timed
from capture_sim.bench import Bench
from capture_sim.kernels import entry_kernel
from capture_sim.launch.scenes import load_scene
from capture_sim.model.equations import N_TOTAL, make_system, rate_of_change
from capture_sim.samples import EventKind
from capture_sim.scene.parts import Scene

_SUPPORT = "{balls: [[0.12, 0.0], [-0.06, 0.104], [-0.06, -0.104]], c_rr: 1.0e-3}"
#: The paper's scene with and without its parts, by what changes it.
PARTS = {
    "vehicles, buffer's springs, contact": ["buffer.c_A=0", "friction.law=none"],
    "+ axial damper": ["friction.law=none"],
    "+ torsional damper as well": ["buffer.c_T=0.2", "friction.law=none"],
    "+ axial damper and friction (tanh): the paper's scene": ["friction.law=tanh"],
    **{
        f"the paper's scene, friction {law}": [f"friction.law={law}"]
        for law in ("clamp", "brown_mcphee", "coulomb")
    },
    "+ stroke stops, never met": [
        "stops={compression: 0.1, extension: 0.1, stiffness: 1.0e+5, damping: 0}"
    ],
    "+ latch, never closed": ["latch={radius: 1.0e-5, stiffness: 2.0e+4, damping: 80}"],
    "+ ball supports": [f"supports={{chaser: {_SUPPORT}, target: {_SUPPORT}}}"],
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
    seconds: Spread  # wall time
    name: str = ""  # what was added to the row before, or changed
    free: float = math.nan  # of one evaluation in free flight and in contact, s, medians
    contact: float = math.nan


@dataclass(frozen=True)
class BatchCost:
    """What ``runs`` runs of as many different scenes cost."""

    runs: int
    seconds: Spread  # wall time, all in all
    preparing: float  # share of it before the integration


def evaluation(scene: Scene, touching: bool, repeats: int) -> float:
    """Return the median time of one evaluation, s, in contact 3 um deep in the -y wall."""
    parameters = packed(scene)
    system = make_system(parameters)
    y = np.concatenate([*scene.initial_coordinates(), np.zeros(N_TOTAL - 16)])
    if touching:
        touch = system["mode"]["touch"][0, 1]
        touch["on"], touch["chi"], touch["direction"] = 1, 1e9, 1.0
        for _ in range(20):
            y[0] += (gap_of_wall(parameters, y, -1.0)[0] + 3e-6) / np.sin(scene.cone.half_angle)
    f, seconds = np.zeros(N_TOTAL), []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        evaluate_often(system, y, f, _LOOP)
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds[1:]) / _LOOP


def run_cost(scene: Scene, t_end: float, repeats: int) -> RunCost:
    """Measure a run to ``t_end`` (s)."""
    scene, times, seconds = with_run(scene, t_end=t_end), np.array([t_end]), []
    for _ in range(repeats):
        warm, bench = Bench(scene), Bench(scene)
        took, _ = timed(lambda b=bench: b.advance(times), lambda b=warm: b.advance(times))
        seconds.append(took)
    return RunCost(t_end, bench.touches.size, bench.statistics.evaluations, Spread.of(seconds))


def part_costs(
    name: str, t_end: float, quick: bool, repeats: int, progress: Progress
) -> list[RunCost]:
    """Measure a scene with and without its parts; quick: some of them."""
    rows, cases = [], list(PARTS.items())[: 2 if quick else None]
    for number, (what, changes) in enumerate(cases):
        progress.at("cost of parts", number, len(cases), what)
        case = load_scene(name, changes)
        free, contact = (evaluation(case, on, repeats) for on in (False, True))
        cost = run_cost(case, t_end, repeats)
        rows.append(dataclasses.replace(cost, name=what, free=free, contact=contact))
    return rows


def rail_cost(scene: Scene, repeats: int) -> RunCost:
    """Measure a scene with rail and string from the release to the rail's end."""
    bench = Bench(scene)
    bench.advance(np.zeros(0))
    end = next(event.t for event in bench.events if event.kind is EventKind.RAIL_END)
    cost = run_cost(scene, 0.999 * end, repeats)
    return dataclasses.replace(cost, name=f"rail and string (closed form), {cost.t_end:.3g} s")


def batch_cost(scene: Scene, t_end: float, size: int, repeats: int) -> BatchCost:
    """Measure runs that differ in the speed of the approach, one after the other."""
    scene, times = with_run(scene, t_end=t_end), np.array([t_end])
    totals, shares = [], []
    for _ in range(repeats):
        preparing = running = 0.0
        for vx in np.linspace(0.05, 0.15, size).tolist():
            began = time.perf_counter()
            chaser = dataclasses.replace(scene.initial.chaser, vx=vx)
            initial = dataclasses.replace(scene.initial, chaser=chaser)
            bench = Bench(dataclasses.replace(scene, initial=initial))
            ready = time.perf_counter()
            bench.advance(times)
            preparing += ready - began
            running += time.perf_counter() - ready
        totals.append(preparing + running)
        shares.append(preparing / totals[-1])
    return BatchCost(size, Spread.of(totals), statistics.median(shares))
