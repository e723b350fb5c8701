"""The table of results: what a person reads off it."""

from __future__ import annotations

import math
import re

import pytest

import capture_sim
from capture_sim.run.summary_table import heads, rows, table

NAMES = ("tilt_0", "tilt_m10", "paper_undamped", "paper_clamped")


@pytest.fixture(scope="module")
def results():
    return [capture_sim.simulate(capture_sim.load_scene(name)) for name in NAMES]


def test_table_fits_a_hundred_columns_and_has_a_unit_over_every_number(results):
    lines = table([run.summary for run in results]).splitlines()
    assert max(map(len, lines)) <= 100
    groups, names, units, rule, row = lines[:5]
    assert set(rule) == {"─"}
    assert {"contact", "touch", "buffer", "latch"} <= set(groups.split())
    cells = list(re.finditer(r"\S+", row))
    columns = [column for column in heads() if column[1] not in ("experiment", "verdict", "n")]
    numbers = [cell for cell in cells[2:] if "." in cell.group()]
    for cell, (_, name, unit) in zip(numbers, columns, strict=True):
        # right-aligned under its unit and its name
        assert units[: cell.end()].endswith(unit)
        assert names[: cell.end()].endswith(name.split()[-1])


def test_table_holds_the_runs_numbers(results):
    for run in results:
        row, *until_latch = rows([run.summary])
        by_head = {(group, name): cell for (group, name, _), cell in zip(heads(), row, strict=True)}
        first = run.touches["start"].min()
        assert float(by_head["contact", "time"]) == pytest.approx(first, abs=5e-4)
        assert int(by_head["touch", "n"]) == len(run.touches)
        peak = run.touches["peak_force"].max()
        assert float(by_head["touch", "peak"]) == pytest.approx(peak, abs=0.05)
        assert float(by_head["", "to BE"]) == pytest.approx(
            run.samples["tip_distance"].min() * 1e3, abs=0.005
        )
        stroke = run.samples["axial_stroke"] * 1e3
        assert float(by_head["buffer", "in"]) == pytest.approx(-stroke.min(), abs=0.01)
        latch = next((e.t for e in run.events if e.kind.label == "latched"), None)
        assert len(until_latch) == (latch is not None)
        for earlier in until_latch:
            inwards = float(earlier[row.index(by_head["buffer", "in"])])
            assert inwards == pytest.approx(-stroke[run.t < latch].min(), abs=0.01)


def test_run_without_a_touch_has_dashes():
    run = capture_sim.simulate(capture_sim.load_scene("tilt_0"), t_end=0.5)
    [row] = rows([run.summary])
    cells = dict(zip(heads(), row, strict=True))
    assert cells["contact", "time", "s"] == "-"
    assert cells["latch", "force", "N"] == "-"
    assert max(map(len, table([run.summary]).splitlines())) <= 100


def test_normal_impulse_is_of_all_touches(results):
    for run in results:
        every = run.touches["impulse"].tolist()
        assert len(every) > 1
        assert run.summary["normal_impulse"] == pytest.approx(math.fsum(every))
        assert run.summary["normal_impulse"] > 1.01 * max(every)
