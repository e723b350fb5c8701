"""Designs over random scenes, each answer checked by runs that the design did not make.

    python -m benchmarks.design         # half an hour; --scenes 2 for a look
    python -m benchmarks.design grid    # the requirements of one scene, five minutes

Writes the parts of docs/random_scenes.md and the figures.  A buffer for limits is compared with a
grid of 20^3 buffers around it, and with the grid over the whole ranges where none was found.  A
buffer for the strokes of the first contact is checked by runs at a tenth of the tolerance.
"""

from __future__ import annotations

import itertools
import math
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.pages import DOCS, table, write_parts
from capture_sim import load_scene, simulate
from capture_sim.run.first_contact import first_cluster
from capture_sim.scene.approach import Approach, placed
from capture_sim.scene.launch_plan import travel_to_touch
from capture_sim.scene.parts import Scene
from capture_sim.studies.design import FREE, OBJECTIVE, Design, Requirements, design_buffer
from capture_sim.studies.executors import answers, open_executor
from capture_sim.studies.limits import Limit, make_limits
from capture_sim.studies.outcome import run_first_contact, run_to_end
from capture_sim.studies.paper_flow import (
    FirstContactTarget,
    design_first_contact,
    with_buffer,
)
from capture_sim.studies.sweep import Recipe, result_columns, run_rows
from capture_sim.viewing.canvas import save
from capture_sim.viewing.studies import draw_first_contact_design, draw_trade_off

SERVICER = DOCS.parent / "examples" / "servicer.yaml"
#: Relative error of a stroke of the first contact that confirms a design.
WITHIN = 0.02
#: The grid around a design: buffers along each axis, and the largest deviation of each value.
GRID, WIDTH = 20, 0.2
_CHUNK = 100
#: Runs of the grid are given up beyond this multiple of the design's force: no better buffer, and
#: the least force of the grid is known if it is below.
_SHOWN = 1.05
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


def forces_within(
    scene: Scene, limits: tuple[Limit, ...], buffers, executor, most: float = math.inf
) -> np.ndarray:
    """Return the peak force of each buffer, N; infinite where it exceeds ``most`` or a limit."""
    rows = list(buffers)
    chunks = [rows[k : k + _CHUNK] for k in range(0, len(rows), _CHUNK)]
    ceilings = {**{limit.key: limit.value for limit in limits}, OBJECTIVE: most}
    work = partial(run_rows, Recipe(scene, FREE), False, limits, ceilings=ceilings)
    columns = result_columns(check=False, limited=True)
    done = [row for found in answers(executor, work, chunks) for row in found]
    by_name = dict(zip(columns, zip(*done, strict=True), strict=True))
    is_good = np.array(by_name["verdict"]) == "captured"
    is_good &= np.array(by_name["exceeded"]) == ""
    return np.where(is_good, np.array(by_name["max_normal_force"], dtype=float), np.inf)


def grid_around(design: Design) -> Iterator[tuple[float, ...]]:
    """Yield the buffers of the grid around a design, or over the whole ranges of a refusal."""
    axes = []
    for variable in design.variables:
        if design.met:
            ends = design.best.values[variable.name] * np.array([1.0 - WIDTH, 1.0 + WIDTH])
            axes.append(np.linspace(*ends, GRID).tolist())
        else:
            axes.append(np.geomspace(variable.low, variable.high, GRID).tolist())
    yield from itertools.product(*axes)


def limits_row(name: str, scene: Scene, limits: tuple[Limit, ...], executor) -> tuple[bool, list]:
    """Design within limits and compare with the grid; return whether it is confirmed, its row."""
    design = design_buffer(scene, Requirements(limits), executor=executor)
    most = _SHOWN * design.best.peak_force if design.met else math.inf
    least = float(forces_within(scene, limits, grid_around(design), executor, most).min())
    given = "; ".join(f"{limit.text}" for limit in limits if limit.key != "max_axial_stroke_out")
    row = [name, given, str(len(design.history))]
    if not design.met:
        holds = math.isinf(least)
        return holds, [*row, "none", "none" if holds else f"{least:.1f}", _YES_OR_NO[holds]]
    finer = replace(design.scene, run=replace(scene.run, rtol=0.1 * scene.run.rtol))
    outcome = run_to_end(finer)
    kept = all(outcome.loads[limit.key] <= limit.value * 1.001 for limit in limits)
    holds = outcome.captured and kept and design.best.peak_force <= least
    values = ", ".join(f"{design.best.values[variable]:.4g}" for variable in FREE)
    found = f"{design.best.peak_force:.2f} ({values})"
    of_grid = f"{least:.2f}" if math.isfinite(least) else f"above {most:.1f}"
    return holds, [*row, found, of_grid, _YES_OR_NO[holds]]


def grid(_: Namespace, __: Path) -> list[str]:
    """The servicer's design for several requirements, against grids of 20^3 buffers."""
    scene = load_scene(SERVICER)
    strokes = {"max_axial_stroke_in": 0.015, "max_axial_stroke_out": 0.015}
    requirements = (
        {**strokes, "max_torsion": 0.015},
        {**strokes, "max_torsion": 0.03, OBJECTIVE: 345.0},
        {"max_axial_stroke_in": 0.03, "max_buffer_force": 30.0},
        {"max_axial_stroke_in": 0.01, "max_torsion_before_latch": 0.005},
    )
    return _compared([("servicer.yaml", scene, make_limits(each)) for each in requirements])


def limits(asked: Namespace, _: Path) -> list[str]:
    """Designs within limits of random scenes, against grids of 20^3 buffers."""
    cases = []
    rng = np.random.default_rng(asked.seed + 1)
    for number, (scene, speed) in enumerate(random_scenes(asked.scenes, asked.seed)):
        stroke = 7.68e-3 * speed / 0.1 * math.exp(rng.uniform(math.log(0.5), math.log(2.2)))
        torsion = 2.0e-3 * speed / 0.1 * math.exp(rng.uniform(math.log(0.3), math.log(3.0)))
        given = {"max_axial_stroke_in": stroke, "max_axial_stroke_out": stroke}
        given["max_torsion"] = torsion
        if number % 5 == 4:
            given["max_normal_force"] = 300.0 * (speed / 0.1) ** 1.2 * rng.uniform(0.7, 2.0)
        kind = "supports" if scene.supports else "free"
        cases.append((f"{number}, {kind}", scene, make_limits(given)))
    return _compared(cases)


def _compared(cases: Sequence[tuple[str, Scene, tuple[Limit, ...]]]) -> list[str]:
    rows, held = [], 0
    with open_executor() as executor:
        for case in cases:
            holds, row = limits_row(*case, executor)
            held += holds
            rows.append(row)
            print(" | ".join(row), flush=True)
    head = ["scene", "limits", "buffers tried"]
    head += ["least force N (k_A N/m, k_T N m/rad, c_A N s/m)", "least of the grid N", "confirmed"]
    return [f"{held} of {len(cases)} answers are confirmed.", "", table(head, rows)]


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
        save(draw_first_contact_design(design), DOCS / "design" / "design.png")
        strokes = [
            design_first_contact(scene, replace(target, axial_stroke=factor * own.axial_stroke))
            for factor in np.geomspace(0.3, 3.0, 9).tolist()
        ]
        save(draw_trade_off(strokes), DOCS / "design" / "trade_off.png")
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
        {"paper": paper, "grid": grid, "limits": limits, "first_contact": first_contact},
        scenes=(8, "random scenes"),
        untimed=("paper", "grid", "limits", "first_contact"),
        seed=(7, "of the random scenes"),
    )
