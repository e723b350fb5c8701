"""What things cost: one evaluation and its arithmetic, parts, simulated time, touches, batches."""

from __future__ import annotations

import dataclasses
import gc
import math
import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np

from benchmarks.engines.own import with_run
from benchmarks.engines.problems import into_wall, packed
from benchmarks.trial import Progress, spread
from capture_sim.bench import Bench
from capture_sim.kernels import entry_kernel
from capture_sim.model import equations
from capture_sim.model.equations import MODE, N_TOTAL, OUT, make_system, rate_of_change
from capture_sim.scene.parts import BallSupport, Latch, Scene, Stops, Supports

_LOOP = 20_000  # evaluations in one measurement of an evaluation


@entry_kernel
def evaluate_often(systems, y, f, n):  # type: ignore[no-untyped-def]
    """Evaluate the equations of motion ``n`` times, each waiting for the one before."""
    for _ in range(n):
        rate_of_change(0.0, y, f, systems[0])
        y[0] += 1e-18 * f[8]


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of a measurement."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: list[float]) -> Spread:
        """Return the spread of values."""
        return cls(statistics.median(values), *spread(values))


@dataclass(frozen=True)
class EvaluationCost:
    """Time of one evaluation of the equations of motion, s."""

    free: Spread
    sliding: Spread  # in contact, slip far above v_eps
    creeping: Spread  # in contact, slip about v_eps


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


def evaluation_cost(scene: Scene, repeats: int) -> EvaluationCost:
    """Measure one evaluation."""
    slow = dataclasses.replace(scene.initial.chaser, vx=1e-3 * np.sqrt(2.0))
    creeping = dataclasses.replace(scene, initial=dataclasses.replace(scene.initial, chaser=slow))
    return EvaluationCost(
        free=_evaluation(scene, touching=False, repeats=repeats),
        sliding=_evaluation(scene, touching=True, repeats=repeats),
        creeping=_evaluation(creeping, touching=True, repeats=repeats),
    )


def _evaluation(scene: Scene, touching: bool, repeats: int) -> Spread:
    system = make_system(packed(scene))
    mode = system["mode"]
    q, v = scene.initial_coordinates()
    y = np.concatenate([q, v, np.zeros(N_TOTAL - 16)])
    if touching:
        mode["touching"][0, 1] = 1
        mode["chi"][0] = 1e9
        mode["direction"][0] = 1.0
        y[0] = into_wall(scene)
    f = np.zeros(N_TOTAL)
    evaluate_often(system, y, f, _LOOP)
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        evaluate_often(system, y, f, _LOOP)
        seconds.append((time.perf_counter() - began) / _LOOP)
    return Spread.of(seconds)


def _timed(job: Callable[[], object], warm: Callable[[], object] = lambda: None) -> float:
    gc.collect()
    gc.disable()
    try:
        warm()
        began = time.perf_counter()
        job()
        return time.perf_counter() - began
    finally:
        gc.enable()


def _run(scene: Scene, repeats: int) -> tuple[Bench, Spread]:
    """Run a scene to its end some times; return the last bench and the wall times."""
    times, seconds = np.array([scene.run.t_end]), []
    for _ in range(repeats):
        warm, bench = Bench(scene), Bench(scene)
        seconds.append(
            _timed(lambda b=bench: b.advance(times), lambda b=warm: b.advance(times))  # type: ignore[misc]
        )
    return bench, Spread.of(seconds)


def parts(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """Yield the paper's scene with and without its parts, each with its name."""

    def change(old: Scene, **values: object) -> Scene:
        new = {
            name: dataclasses.replace(getattr(old, name), **value)
            if isinstance(value, dict)
            else value
            for name, value in values.items()
        }
        return dataclasses.replace(old, **new)  # type: ignore[arg-type]

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
    balls = ((0.12, 0.0), (-0.06, 0.104), (-0.06, -0.104))
    support = BallSupport(balls, 1e-3)
    yield "+ ball supports", change(rubbing, supports=Supports(support, support))


def part_costs(scene: Scene, t_end: float, repeats: int, progress: Progress) -> list[RunCost]:
    """Measure the paper's scene with and without its parts."""
    rows = []
    cases = list(parts(scene))
    for number, (name, case) in enumerate(cases):
        progress.at("cost of parts", number, len(cases), name)
        free, contact = (_evaluation(case, on, repeats).median for on in (False, True))
        cost = run_cost(case, t_end, repeats)
        rows.append(dataclasses.replace(cost, name=name, free=free, contact=contact))
    return rows


def rail_cost(scene: Scene, repeats: int) -> RunCost:
    """Measure a scene with rail and string from the release to the rail's end."""
    bench = Bench(scene)
    bench.advance(np.zeros(0))
    end = next(event.t for event in bench.events if event.kind.label == "rail_end")
    cost = run_cost(scene, 0.999 * end, repeats)
    return dataclasses.replace(cost, name=f"rail and string (closed form), {cost.t_end:.3g} s")


def run_cost(scene: Scene, t_end: float, repeats: int) -> RunCost:
    """Measure a run to ``t_end`` (s)."""
    bench, seconds = _run(with_run(scene, t_end=t_end), repeats)
    return RunCost(t_end, bench.touches.size, bench.statistics.evaluations, seconds)


def batch_costs(
    scene: Scene, t_end: float, sizes: tuple[int, ...], repeats: int, progress: Progress
) -> list[BatchCost]:
    """Measure batches of runs that differ in the speed of the approach, one after the other."""
    scene = with_run(scene, t_end=t_end)
    rows = []
    for number, size in enumerate(sizes):
        progress.at("cost of batches", number, len(sizes), f"{size} runs")
        totals, shares = [], []
        for _ in range(repeats):
            preparing, running = _batch(scene, size)
            totals.append(preparing + running)
            shares.append(preparing / (preparing + running))
        rows.append(BatchCost(size, Spread.of(totals), statistics.median(shares)))
    return rows


def _batch(scene: Scene, size: int) -> tuple[float, float]:
    """Run ``size`` scenes; return the wall times before and in the integration, s."""
    preparing = running = 0.0
    times = np.array([scene.run.t_end])
    for vx in np.linspace(0.05, 0.15, size):
        began = time.perf_counter()
        chaser = dataclasses.replace(scene.initial.chaser, vx=float(vx))
        initial = dataclasses.replace(scene.initial, chaser=chaser)
        bench = Bench(dataclasses.replace(scene, initial=initial))
        ready = time.perf_counter()
        bench.advance(times)
        preparing += ready - began
        running += time.perf_counter() - ready
    return preparing, running


# The kernels are run as the Python functions that they were made from, with numbers that count
# what is done with them.

calls: Counter[str] = Counter()


class Counted(float):
    """A number that counts its operations."""

    def _count(self, what: str, value: Any) -> Any:
        calls[what] += 1
        return Counted(value)

    def __add__(self, other: Any) -> Any:
        return self._count("add", float(self) + float(other))

    def __sub__(self, other: Any) -> Any:
        return self._count("add", float(self) - float(other))

    def __rsub__(self, other: Any) -> Any:
        return self._count("add", float(other) - float(self))

    def __mul__(self, other: Any) -> Any:
        return self._count("multiply", float(self) * float(other))

    def __truediv__(self, other: Any) -> Any:
        return self._count("divide", float(self) / float(other))

    def __rtruediv__(self, other: Any) -> Any:
        return self._count("divide", float(other) / float(self))

    def __neg__(self) -> Any:
        return Counted(-float(self))

    def __abs__(self) -> Any:
        return Counted(abs(float(self)))

    __radd__ = __add__
    __rmul__ = __mul__
    __hash__ = float.__hash__


def _watched(name: str) -> Any:
    function = getattr(math, name)

    def call(*values: Any) -> Any:
        calls[name] += 1
        return Counted(function(*map(float, values)))

    return call


_library = SimpleNamespace(**vars(math))
for _name in ("sqrt", "tanh", "sin", "cos", "hypot"):
    setattr(_library, _name, _watched(_name))


def plain(kernel: Any) -> Any:
    """Return a compiled kernel as the Python function that it was made from, counting.

    So are the kernels that it calls.
    """
    function = kernel.py_func
    names = dict(function.__globals__)
    for name in function.__code__.co_names:
        value = names.get(name)
        if value is math:
            names[name] = _library
        elif hasattr(value, "py_func"):
            names[name] = plain(value)
    return FunctionType(function.__code__, names)


def operations(scene: Scene) -> dict[str, dict[str, int]]:
    """Return how often an evaluation adds, multiplies, divides, ..., in "free" and "contact".

    The scene stands as at its release, with the tip 3 um deep in the -y wall for "contact".
    """
    record = packed(scene)
    values = {name: record[name][0] for name in record.dtype.names or ()}
    par = SimpleNamespace(
        **{k: Counted(v) if isinstance(v, np.floating) else v for k, v in values.items()}
    )
    q, v = scene.initial_coordinates()
    mode = SimpleNamespace()
    for name in MODE.names or ():
        shape = MODE[name].shape
        setattr(mode, name, [0] * shape[0] if shape else 0)
    mode.chi = [Counted(1e9)] * 2
    evaluate = plain(equations.rate_of_change)
    counts = {}
    for phase, touching in (("free", [0, 0]), ("contact", [0, 1])):
        mode.touching = touching
        q[0] = into_wall(scene) if phase == "contact" else q[0]
        y = [Counted(value) for value in (*q, *v, *[0.0] * (N_TOTAL - 16))]
        f = [Counted(0.0)] * N_TOTAL
        out = SimpleNamespace(
            **{k: [Counted(0.0)] * 2 if OUT[k].shape else Counted(0.0) for k in OUT.names or ()}
        )
        calls.clear()
        evaluate(0.0, y, f, SimpleNamespace(par=par, mode=mode, out=out))
        counts[phase] = dict(calls)
    return counts
