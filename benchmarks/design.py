"""Designs checked by runs that the design did not make: fronts, and the paper's flow.

    python -m benchmarks.design           # half an hour; --scenes 2 for a look
    python -m benchmarks.design fronts    # six designs against the best known, 30 minutes
    python -m benchmarks.design alone limit   # rows and costs of limits against SciPy alone

Writes the parts of docs/evidence/random_scenes.md and the figures.  A row of a front is compared
with the best buffer that any call has found at its stroke.  What objectives trade is read
from grids of 20^3 buffers over the search ranges; the grids are kept.  A buffer for the strokes of
the first contact is checked by runs at a tenth of the tolerance.
"""

from __future__ import annotations

import itertools
import json
import math
import resource
import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.pages import DOCS, EVIDENCE, table, write_parts
from capture_sim import load_scene, simulate
from capture_sim.run.first_contact import first_cluster
from capture_sim.scene.approach import Approach, placed
from capture_sim.scene.launch_plan import travel_to_touch
from capture_sim.scene.parts import Scene
from capture_sim.studies.evaluate.executors import InProcess, answers, open_executor
from capture_sim.studies.evaluate.limits import (
    LOAD_KEYS,
    Limit,
    Measure,
    make_limits,
    make_objectives,
)
from capture_sim.studies.evaluate.outcome import run_first_contact, run_to_end
from capture_sim.studies.evaluate.sweep import RTOL, Recipe, result_columns, run_rows
from capture_sim.studies.search.design import costs_of_limits, design_buffer
from capture_sim.studies.search.evaluator import Candidate, Requirements
from capture_sim.studies.search.front import layers
from capture_sim.studies.search.limit_costs import STEPS
from capture_sim.studies.search.paper_flow import (
    FirstContactTarget,
    design_first_contact,
    with_buffer,
)
from capture_sim.studies.search.rows import DesignRow
from capture_sim.studies.search.search import Window
from capture_sim.studies.search.variables import FREE, make_variables, with_values
from capture_sim.viewing.canvas import save
from capture_sim.viewing.studies import draw_first_contact_design

SERVICER = DOCS.parent / "examples" / "servicer.yaml"
#: Relative error of a stroke of the first contact that confirms a design.
WITHIN = 0.02
#: Buffers along each axis of a grid.
GRID = 20
GRIDS = DOCS.parent / "build" / "design_grids"
_CHUNK = 100
_YES_OR_NO = {True: "yes", False: "**NO**"}


def random_scenes(count: int, seed: int) -> Iterator[tuple[Scene, float]]:
    """Yield scenes with their speed, m/s: every fourth on supports.

    Speed 0.04 to 0.2 m/s, offset 3 to 45 mm to either side, angle up to 10 degrees.
    """
    rng = np.random.default_rng(seed)
    free = load_scene("paper_designed")
    bench = load_scene("tilt_0", ["latch=null", "run.t_end=6.0"])
    number = 0
    while number < count:
        speed = math.exp(rng.uniform(math.log(0.04), math.log(0.2)))
        approach = Approach(
            math.radians(rng.uniform(-10.0, 10.0)),
            rng.uniform(0.003, 0.045) * rng.choice([-1.0, 1.0]),
            speed,
        )
        near = placed(bench if number % 4 == 3 else free, approach)
        if math.isfinite(travel_to_touch(near)):
            yield near, speed
            number += 1


class Case(NamedTuple):
    """A scene to design, its limits, and a scene's name for the table."""

    name: str
    scene: Scene
    limits: tuple[Limit, ...] = ()


def cases(asked: Namespace) -> list[Case]:
    """Return the six scenes; tilt_p10 also with the torsion of its own buffer as the limit."""
    names = ("tilt_0", "tilt_p10", "tilt_m10", "paper_designed")
    found = [Case(name, load_scene(name)) for name in names]
    found.append(Case("servicer", load_scene(SERVICER)))
    found.append(Case("random", list(random_scenes(2, asked.seed))[1][0]))
    found.insert(2, found[1]._replace(limits=make_limits({"max_torsion": 8.1e-3})))
    return found


def grid_of(case: Case, folder: Path) -> dict[str, np.ndarray]:
    """Return the results of 20^3 buffers over the search ranges without limits, by column.

    They are kept in a folder, in which a later call finds them.
    """
    path = folder / f"grid_{case.name}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        axes = [
            np.geomspace(each.low, each.high, GRID).tolist()
            for each in make_variables(case.scene, (), FREE)
        ]
        rows = list(itertools.product(*axes))
        chunks = [rows[k : k + _CHUNK] for k in range(0, len(rows), _CHUNK)]
        coarse = replace(case.scene, run=replace(case.scene.run, rtol=RTOL))
        work = partial(run_rows, Recipe(coarse, FREE), False, ())
        with open_executor() as executor:
            done = [row for found in answers(executor, work, chunks) for row in found]
        names = result_columns(check=False, limited=False)
        columns = dict(zip(names, zip(*done, strict=True), strict=True))
        kept = ("verdict", *LOAD_KEYS)
        np.savez(path, **{name: np.array(columns[name]) for name in kept})
    with np.load(path) as grid:
        return {name: grid[name] for name in ("verdict", *LOAD_KEYS)}


def front_of_grid(
    grid: dict[str, np.ndarray], objectives: Sequence[Measure], limits: Sequence[Limit]
) -> np.ndarray:
    """Return the front of the buffers of a grid that capture within limits, (n, objectives)."""
    is_good = grid["verdict"] == "captured"
    for limit in limits:
        is_good &= np.nan_to_num(grid[limit.key]) <= limit.value
    points = np.array(
        [[each.cost(x) for x in grid[each.key][is_good].tolist()] for each in objectives]
    ).T
    return points[layers(points)[0]]


def cpu_time() -> float:
    """Return the CPU time of this process and of those that it has awaited, s."""
    of_children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + of_children.ru_utime + of_children.ru_stime


class Trial(NamedTuple):
    """A design whose best known result is kept: a scene, its limits, what is free."""

    name: str
    scene: str
    minimize: tuple[str, ...]
    limits: dict[str, str]
    free: tuple[str, ...] = FREE
    window: tuple[float, float] | None = None  # of the stroke, m


_STROKE_AND_FORCE = ("max_axial_stroke_in", "max_buffer_force")
TRIALS = (
    Trial("tilt_p10", "tilt_p10", _STROKE_AND_FORCE, {}, window=(0.0033, 0.01)),
    Trial(
        *("tilt_p10, torsion <= 8.1 mrad", "tilt_p10", _STROKE_AND_FORCE),
        {"max_torsion": "8.1 mrad"},
        window=(0.0033, 0.01),
    ),
    Trial("tilt_0", "tilt_0", _STROKE_AND_FORCE, {}, window=(0.0033, 0.01)),
    Trial(
        *("one objective, stroke <= 6 mm", "tilt_p10", _STROKE_AND_FORCE[1:]),
        {"max_axial_stroke_in": "6 mm"},
    ),
    Trial(
        *("one objective, k_A and c_A, stroke <= 6 mm", "tilt_p10", _STROKE_AND_FORCE[1:]),
        {"max_axial_stroke_in": "6 mm"},
        ("buffer.k_A", "buffer.c_A"),
    ),
    Trial(
        *("servicer", str(SERVICER), _STROKE_AND_FORCE),
        {
            "max_axial_stroke_in": "15 mm",
            "max_axial_stroke_out": "15 mm",
            "max_torsion": "30 mrad",
            "max_normal_force": "345",
        },
        window=(0.01, 0.014),
    ),
)
#: Stroke, m, and force, N, of the best buffers of each trial that any run of this program has
#: found.  It only improves.
BEST = Path(__file__).parent / "references" / "design_best.json"
_MOST_KEPT = 400


def best_known(name: str, found: Sequence[Candidate]) -> np.ndarray:
    """Return the front (n, 2) of stroke and force of what is known and what was found; keep it."""
    known = json.loads(BEST.read_text()) if BEST.exists() else {}
    points = [
        [x.loads["max_axial_stroke_in"], x.loads["max_buffer_force"]] for x in found if x.feasible
    ]
    every = np.array(sorted([*known.get(name, []), *points]))
    front = every[every[:, 1] < np.append(np.inf, np.minimum.accumulate(every[:, 1])[:-1])]
    known[name] = front[np.unique(np.linspace(0, len(front) - 1, _MOST_KEPT).astype(int))].tolist()
    BEST.write_text(json.dumps(known, indent=0) + "\n")
    return front


def stroke_of(row: DesignRow, trial: Trial) -> float:
    """Return the stroke that a row may have, m: its own ceiling, or the trial's limit."""
    ceiling = row.goal.ceilings[0] if trial.window is not None else math.inf
    if math.isfinite(ceiling):
        return math.exp(ceiling) / Measure("max_axial_stroke_in").load.factor
    limits = {limit.key: limit.value for limit in make_limits(trial.limits)}
    return limits.get("max_axial_stroke_in", math.inf)


def fronts(asked: Namespace, _: Path) -> list[str]:
    """Designs of six cases, each row against the best that is known at its stroke."""
    rows = []
    for trial in TRIALS:
        if asked.only and asked.only not in trial.name:
            continue
        scene = load_scene(trial.scene)
        requirements = Requirements(make_objectives(trial.minimize), make_limits(trial.limits))
        window = None if trial.window is None else Window(trial.minimize[0], *trial.window)
        found = []
        for seed in range(asked.search_seed, asked.search_seed + asked.seeds):
            began = cpu_time()
            design = design_buffer(scene, requirements, trial.free, window=window, seed=seed)
            found.append((design, cpu_time() - began))
            best_known(trial.name, design.history)
            print(trial.name, seed, f"{found[-1][1]:.1f} s", flush=True)
        gaps: list[float] = []
        words: list[str] = []
        agree = 0
        for design, _ in found:
            known = best_known(trial.name, design.history)
            for row in design.rows:
                loads = row.candidate.loads
                reach = known[known[:, 0] <= stroke_of(row, trial) * (1.0 + 1e-5)]
                gaps.append(float(loads["max_buffer_force"] / reach[:, 1].min()) - 1.0)
                words.append(row.convergence)
                run = run_to_end(design.scene_of(row.candidate))
                agree += run.loads["max_buffer_force"] == loads["max_buffer_force"] and (
                    run.captured and not run.left_again
                )
        n_converged = sum(word == "converged" for word in words)
        rows.append(
            [
                trial.name,
                str(len(found)),
                str(len(gaps)),
                f"{np.mean([len(design.history) for design, _ in found]):.0f}",
                f"{np.mean([seconds for _, seconds in found]):.1f}",
                f"{max(np.mean(gaps), 0.0):.2%}" if gaps else "-",
                f"{max(max(gaps), 0.0):.2%}" if gaps else "-",
                f"{n_converged} of {len(words)}",
                f"{agree} of {len(words)}",
            ]
        )
        print(" | ".join(rows[-1]), flush=True)
    head = ["case", "seeds", "rows", "runs of a design", "CPU s", "mean gap", "largest gap"]
    head += ["rows that say converged", "rows that run to their figures and stay"]
    return [table(head, rows)]


#: Strokes, m, at which SciPy searches on its own, and a limit of the stroke whose cost it finds.
_ALONE_AT, _COST_AT = (0.0033, 0.0074), 0.006


def by_scipy(scene: Scene, free: Sequence[str], stroke: float, seed: int) -> tuple[float, int]:
    """Return the least force, N, within a stroke, m, that SciPy alone finds, and its runs.

    Differential evolution over the search ranges, then Nelder-Mead from its best point and from
    three around it: the logarithm of the force, with a penalty for what is exceeded.
    """
    from scipy.optimize import differential_evolution, minimize

    variables = make_variables(scene, make_limits({"max_axial_stroke_in": _COST_AT}), free)
    coarse = replace(scene, run=replace(scene.run, rtol=RTOL))
    runs, least = 0, math.inf

    def cost(shares: np.ndarray) -> float:
        nonlocal runs, least
        runs += 1
        values = {
            each.name: each.value(float(min(max(share, 0.0), 1.0)))
            for each, share in zip(variables, shares, strict=True)
        }
        found = run_to_end(with_values(coarse, values))
        if not found.captured or found.left_again:
            return 30.0
        force, own = found.loads["max_buffer_force"], found.loads["max_axial_stroke_in"]
        if own <= stroke:
            least = min(least, force)
        return math.log(force) + 10.0 * max(0.0, math.log(own / stroke))

    wide = differential_evolution(
        cost, [(0.0, 1.0)] * len(variables), maxiter=40, popsize=12, seed=seed, polish=False
    )
    points = [wide.x, *np.random.default_rng(seed).normal(wide.x, 0.05, (3, wide.x.size))]
    for point in points:
        best = np.clip(point, 0.0, 1.0)
        for size in (0.05, 0.01, 0.002):
            corners = np.vstack([best, *(best + size * row for row in np.eye(best.size))])
            options = {"initial_simplex": corners, "maxfev": 150, "xatol": 1e-7, "fatol": 1e-9}
            best = minimize(cost, best, method="Nelder-Mead", options=options).x
    return least, runs


def alone(asked: Namespace, _: Path) -> list[str]:
    """Designs of tilt_p10 against SciPy alone, which has none of the search's code."""
    scene, objectives = load_scene("tilt_p10"), make_objectives(["max_buffer_force"])
    rows = []
    for stroke in _ALONE_AT:
        requirements = Requirements(objectives, make_limits({"max_axial_stroke_in": stroke}))
        design = design_buffer(scene, requirements, seed=asked.search_seed)
        row = design.rows[0]
        force = float(row.candidate.loads["max_buffer_force"])
        found = [by_scipy(scene, FREE, stroke, seed) for seed in range(asked.seeds)]
        least = min(each for each, _ in found)
        cells = [f"{stroke * 1e3:.1f} mm", f"{force:.4f}", row.convergence]
        cells += [f"{len(design.history)}", ", ".join(f"{each:.4f}" for each, _ in found)]
        rows.append([*cells, f"{sum(n for _, n in found)}", f"{force / least - 1.0:+.2%}"])
    head = ["stroke", "design, N", "says", "runs", "SciPy alone, N, by seed", "its runs"]
    return [table([*head, "design against SciPy's best"], rows)]


def limit(asked: Namespace, _: Path) -> list[str]:
    """What 1 and 5 per cent more of a limit bring, against optimisations by SciPy alone."""
    scene, free = load_scene("tilt_p10"), ("buffer.k_A", "buffer.c_A")
    requirements = Requirements(
        make_objectives(["max_buffer_force"]), make_limits({"max_axial_stroke_in": _COST_AT})
    )
    rows = []
    by_step = {}
    for step in (0.0, *STEPS):
        found = [by_scipy(scene, free, _COST_AT * (1.0 + step), seed) for seed in range(3)]
        by_step[step] = min(force for force, _ in found)
    for seed in range(asked.search_seed, asked.search_seed + asked.seeds):
        design = design_buffer(scene, requirements, free, seed=seed)
        (cost,) = costs_of_limits(design, design.rows[0], seed=seed)
        cells = [str(seed)]
        for step, (change,) in zip(STEPS, cost.changes, strict=True):
            dense = by_step[step] / by_step[0.0] - 1.0
            cells += [f"{change.value:+.3%} +- {change.error:.3%}", f"{dense:+.3%}"]
        rows.append(cells)
    head = ["seed"]
    for step in STEPS:
        head += [f"{step:.0%} more", "SciPy alone"]
    return [table(head, rows)]


def objectives(asked: Namespace, _: Path) -> list[str]:
    """What different objectives trade, by the grids: within the own strokes and torsion."""
    pairs = [
        ("max_buffer_force", "max_buffer_torque"),
        ("max_buffer_force", "max_normal_force"),
        ("max_buffer_force", "max_axial_stroke_in"),
    ]
    rows = []
    for case in cases(asked):
        if case.limits:
            continue
        loads, grid = run_to_end(case.scene).loads, grid_of(case, asked.grids or GRIDS)
        stroke = max(loads["max_axial_stroke_in"], loads["max_axial_stroke_out"])
        own = {"max_axial_stroke_in": stroke, "max_axial_stroke_out": stroke}
        limits = make_limits({**own, "max_torsion": loads["max_torsion"]})
        is_good = grid["verdict"] == "captured"
        for limit in limits:
            is_good &= np.nan_to_num(grid[limit.key]) <= limit.value
        peaks = grid["max_normal_force"][is_good]
        row = [case.name, f"{(peaks <= 1.01 * peaks.min()).mean():.1%}"]
        force = grid["max_buffer_force"][is_good]
        row.append(f"{(force <= 1.01 * force.min()).mean():.1%}")
        row.append(f"{force.min() / loads['max_buffer_force'] - 1.0:+.0%}")
        for pair in pairs:
            front = front_of_grid(grid, make_objectives(pair), limits)
            row.append(" and ".join(f"{x:.2f}" for x in np.exp(np.ptp(front, axis=0))))
        rows.append(row)
    head = [
        "scene",
        "buffers within 1 % of the least peak normal force",
        "... of the least buffer force",
    ]
    head += ["least buffer force against the own"]
    head += ["force and torque: largest / least", "force and peak normal force", "force and stroke"]
    return [table(head, rows)]


def same(_: Namespace, __: Path) -> list[str]:
    """One seed, in one process, in two, and on a Dask cluster: the same front."""
    from distributed import LocalCluster

    scene = load_scene("tilt_p10")
    traded = make_objectives(["max_axial_stroke_in", "max_buffer_force"])

    def front(executor: Executor) -> tuple[Candidate, ...]:
        return design_buffer(scene, Requirements(traded), candidates=200, executor=executor).front

    here = front(InProcess())
    with open_executor(2) as processes:
        in_two = front(processes)
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        open_executor(scheduler=cluster.scheduler_address) as dask,
    ):
        on_dask = front(dask)
    equal = here == in_two == on_dask
    return [
        f"One process, two processes and a Dask cluster of two workers give the same front of "
        f"{len(here)} buffers: {_YES_OR_NO[equal]}."
    ]


def strokes_off(scene: Scene, target: FirstContactTarget) -> float:
    """Return the largest relative error of a stroke of the first contact, by samples at 20 kHz."""
    b = scene.buffer
    scene = with_buffer(scene, b.k_A, b.k_T, 0.0)
    touches = first_cluster(simulate(scene).touches)
    start, end = touches["start"].min(), touches["end"].max()
    times = np.append(np.arange(start, end, 5e-5), end)
    fine = simulate(scene, t_end=float(end), t_eval=times).samples
    strokes = np.array([np.abs(fine[name]).max() for name in ("axial_stroke", "torsion")])
    return float(np.abs(strokes / (target.axial_stroke, target.torsion) - 1.0).max())


def first_contact(asked: Namespace, _: Path) -> list[str]:
    """Designs as in the paper, for the strokes of the first contact of random scenes."""
    rows, held = [], 0
    rng = np.random.default_rng(asked.seed + 2)
    for number, (scene, speed) in enumerate(random_scenes(asked.scenes, asked.seed)):
        target = FirstContactTarget(
            7.68e-3 * speed / 0.1 * math.exp(rng.uniform(math.log(0.5), math.log(2.2))),
            2.0e-3 * speed / 0.1 * math.exp(rng.uniform(math.log(0.3), math.log(3.0))),
        )
        design = design_first_contact(scene, target)
        strokes = f"{target.axial_stroke * 1e3:.2f} mm, {target.torsion * 1e3:.2f} mrad"
        cells = [str(number), strokes, str(len(design.history))]
        if not design.met:
            rows.append([*cells, f"none: {design.refusal}", "", ""])
            continue
        assert design.scene is not None
        finer = replace(design.scene, run=replace(scene.run, rtol=0.1 * scene.run.rtol))
        verdict, off = simulate(finer).verdict, strokes_off(finer, target)
        holds = verdict == "captured" and off <= WITHIN
        held += holds
        b = design.scene.buffer
        cells.append(f"{b.k_A:.4g}, {b.k_T:.4g}, {b.c_A:.3g}")
        rows.append([*cells, f"{verdict}, {off:.2%}", "yes" if holds else "**NO**"])
    head = ["scene", "target", "runs", "k_A N/m, k_T N m/rad, c_A N s/m"]
    head += ["verdict, error of the strokes", "confirmed"]
    n_found = sum(bool(row[-1]) for row in rows)
    return [f"{held} of {n_found} buffers are confirmed.", "", table(head, rows)]


def paper(asked: Namespace, _: Path) -> list[str]:
    """The paper's springs from the strokes they give."""
    scene = load_scene("paper_undamped")
    own = run_first_contact(scene)
    target = FirstContactTarget(own.axial_stroke, own.torsion)
    design = design_first_contact(scene, target)
    assert design.scene is not None
    assert design.capturing is not None
    assert design.energy is not None
    if not asked.dry:
        save(draw_first_contact_design(design), EVIDENCE / "design" / "design.png")
    b, (low, high), energy = design.scene.buffer, design.capturing, design.energy
    springs = sum(trial.verdict is None for trial in design.history)
    return [
        "In the paper's case, springs of 500 N/m and 200 N m/rad give strokes of "
        f"{own.axial_stroke * 1e3:.4f} mm and {own.torsion * 1e3:.4f} mrad. With these strokes as "
        f"the target, the command returns k_A = {b.k_A:.3f} N/m and k_T = {b.k_T:.3f} N m/rad "
        f"after {springs} runs ({len(design.history)} in all). Dampers from {low:.1f} to "
        f"{high:.1f} N s/m capture; the command returns their logarithmic middle, "
        f"c_A = {b.c_A:.1f} N s/m. Of the approach's {energy.approach * 1e3:.1f} mJ, the damper "
        f"absorbs {energy.damper * 1e3:.2f} mJ (area under load over stroke) and the touches "
        f"{energy.contact * 1e3:.2f} mJ (area under force over penetration)."
    ]


if __name__ == "__main__":
    write_parts(
        "random_scenes",
        __doc__,
        {
            "paper": paper,
            "fronts": fronts,
            "alone": alone,
            "limit": limit,
            "objectives": objectives,
            "same": same,
            "first_contact": first_contact,
        },
        scenes=(8, "random scenes"),
        untimed=("paper", "alone", "limit", "objectives", "same", "first_contact"),
        seed=(7, "of the random scenes"),
        search_seed=(1, "of the searches"),
        seeds=(3, "number of searches of a case"),
        only=("", "part of the names of the cases of fronts to run; empty for all"),
        grids=(None, "folder that keeps the grids (build/design_grids)"),
    )
