"""What things cost: parts of a scene, one evaluation, simulated time, touches, batches."""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.engines.own import packed, with_run
from benchmarks.engines.scipy_ivp import gap_of_wall
from benchmarks.pages import Spread
from benchmarks.trial import Progress, timed
from capture_sim.bench import Bench
from capture_sim.kernels import entry_kernel
from capture_sim.model.equations import N_TOTAL, make_system, rate_of_change
from capture_sim.samples import EventKind
from capture_sim.scene.parts import BallSupport, Latch, Scene, Stops, Supports

_LOOP = 20_000  # evaluations in one measurement of an evaluation


@entry_kernel
def evaluate_often(systems, y, f, n):  # type: ignore[no-untyped-def]
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
        mode = system["mode"]
        mode["touching"][0, 1], mode["chi"][0], mode["direction"][0] = 1, 1e9, 1.0
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


def parts(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """Yield the paper's scene with and without its parts, each with its name."""

    def change(old: Scene, **values: Any) -> Scene:
        new = {
            name: dataclasses.replace(getattr(old, name), **value)
            if isinstance(value, dict)
            else value
            for name, value in values.items()
        }
        return dataclasses.replace(old, **new)

    bare = change(scene, buffer={"c_A": 0.0, "c_T": 0.0}, friction={"law": "none"})
    yield "vehicles, buffer's springs, contact", bare
    damped = change(bare, buffer={"c_A": scene.buffer.c_A})
    yield "+ axial damper", damped
    yield "+ torsional damper as well", change(damped, buffer={"c_T": 0.2})
    rubbing = change(damped, friction={"law": "tanh"})
    yield "+ axial damper and friction (tanh): the paper's scene", rubbing
    for law in ("clamp", "brown_mcphee", "coulomb"):
        yield f"the paper's scene, friction {law}", change(rubbing, friction={"law": law})
    yield "+ stroke stops, never met", change(rubbing, stops=Stops(0.1, 0.1, 1e5, 0.0))
    yield "+ latch, never closed", change(rubbing, latch=Latch(1e-5, 2e4, 80.0))
    support = BallSupport(((0.12, 0.0), (-0.06, 0.104), (-0.06, -0.104)), 1e-3)
    yield "+ ball supports", change(rubbing, supports=Supports(support, support))


def part_costs(
    scene: Scene, t_end: float, quick: bool, repeats: int, progress: Progress
) -> list[RunCost]:
    """Measure the paper's scene with and without its parts; quick: some of them."""
    rows, cases = [], list(parts(scene))[: 2 if quick else None]
    for number, (name, case) in enumerate(cases):
        progress.at("cost of parts", number, len(cases), name)
        free, contact = (evaluation(case, on, repeats) for on in (False, True))
        cost = run_cost(case, t_end, repeats)
        rows.append(dataclasses.replace(cost, name=name, free=free, contact=contact))
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
