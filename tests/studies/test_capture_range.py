"""Capture range: located edges against regions of known area, in sweeps and by hand."""

import numpy as np
import pytest

from capture_sim import SceneError, load_scene
from capture_sim.cli import main
from capture_sim.scene.loading import change_scene
from capture_sim.studies.evaluate.capture_range import (
    area_of_map,
    capture_ranges,
    make_area,
    points_of,
)
from capture_sim.studies.evaluate.outcome import run_to_end
from capture_sim.studies.vary.inputs import Input

NAMES = ("approach.offset", "approach.angle", "approach.speed")


def area(*counts):
    """Return an area from -1 to 1 along each axis."""
    return tuple(
        Input(name, "", tuple(np.linspace(-1.0, 1.0, count).tolist()))
        for name, count in zip(NAMES, counts, strict=False)
    )


def ranges_of(axes, is_inside, cases=1):
    """Return the capture ranges of regions given by a function of case and point."""

    def is_captured(asked):
        return [is_inside(case, *point) for case, point in asked]

    asked = [(case, point) for case in range(cases) for point in points_of(axes)]
    grid = np.array(is_captured(asked)).reshape(cases, -1)
    return grid, capture_ranges(axes, grid, is_captured)


def test_an_edge_is_located_between_the_points_of_the_grid():
    """An interval from -0.37 to 0.71 is 54 % of the line; a grid of 9 points counts 4 of 9."""
    grid, (found,) = ranges_of(area(9), lambda _, x: -0.37 <= x <= 0.71)
    assert abs(grid.mean() - 0.54) > 0.09
    assert found.share == pytest.approx(0.54, abs=2 * 0.25 / 2**6)
    assert found.error == pytest.approx(0.25 / 2**5 / 2.0)
    assert found.runs == 2 * 5


@pytest.mark.parametrize("counts", [(9, 5), (21, 11), (41, 21)])
def test_the_error_covers_a_disc_and_shrinks_with_the_grid(counts):
    true = np.pi * 0.55**2 / 4.0
    _, (found,) = ranges_of(area(*counts), lambda _, x, y: (x - 0.05) ** 2 + y**2 < 0.55**2)
    assert abs(found.share - true) <= found.error
    assert found.error < 2.0 / counts[1]


def test_an_island_within_a_cell_of_half_the_grid_is_in_the_error():
    _, (found,) = ranges_of(area(9), lambda _, x: abs(x - 0.25) < 0.2)
    assert found.share == pytest.approx(0.2, abs=0.01)
    assert found.error > 0.1  # a grid of 5 points would not see it


def test_cases_are_apart_and_three_axes_are_averaged():
    _, (wide, narrow) = ranges_of(
        area(9, 3, 3), lambda case, x, *_: abs(x) < (0.8, 0.4)[case], cases=2
    )
    assert (wide.share, narrow.share) == pytest.approx((0.8, 0.4), abs=0.01)


def test_all_or_nothing_needs_no_runs():
    _, found = ranges_of(area(5, 3), lambda case, *_: case == 0, cases=2)
    assert [(each.share, each.error, each.runs) for each in found] == [(1.0, 0.0, 0), (0.0, 0.0, 0)]


@pytest.mark.parametrize(
    "texts, message",
    [
        (["offset=5 mm:-5 mm:5"], "must be LOW:HIGH:COUNT with LOW < HIGH"),
        (["offset=normal(0, 1 mm)"], "must be LOW:HIGH:COUNT with LOW < HIGH"),
        (["offset"], "approach offset: must be NAME=LOW:HIGH:COUNT, each name once, or idss"),
        (["offset=-1 mm:1 mm:5", "offset=-1 mm:1 mm:3"], "each name once"),
        (["mass=1:2:3"], "approach.mass: must be one of approach.angle"),
        (["offset=-1 mm:1 mm:2"], "one must have 3 values or more"),
        (["idss", "offset=-1 mm:1 mm:5"], "must not vary with approach.offset"),
        (["idss", "speed=0.1:0.2:3"], "each name once"),
    ],
)
def test_what_is_no_area_is_rejected_in_a_line(texts, message):
    with pytest.raises(SceneError, match=message):
        make_area(load_scene("paper_designed"), texts)


def test_the_docking_standard_is_a_ready_area():
    axes = make_area(load_scene("paper_designed"), ["idss"])
    assert {axis.name: (axis.values[0], axis.values[-1]) for axis in axes} == pytest.approx(
        {
            "approach.mouth_offset": (-0.1, 0.1),
            "approach.angle": (-np.radians(4.0), np.radians(4.0)),
            "approach.speed": (0.05, 0.1),
        }
    )


def test_the_area_of_a_map_is_what_it_shows_of_the_approach():
    offset, angle, speed = area(9, 5, 2)
    damper = Input("buffer.c_A", "N s/m", (5.0, 10.0, 15.0))
    assert area_of_map([offset, angle, speed]) == (offset, angle)
    assert area_of_map([damper, offset]) == (offset,)
    assert area_of_map([damper]) == ()
    assert area_of_map([offset, speed]) == ()  # two values locate no second axis


def test_a_sweep_prints_the_capture_range_of_its_map(tmp_path, capsys):
    """Offsets by hand: the share of 33 that are captured is within a cell of theirs."""
    changes = ["--set=run.t_end=1.5", "--workers=1", f"--out={tmp_path / 'map.csv'}"]
    vary = ["--vary=approach.offset=-80 mm:80 mm:5", "--vary=buffer.c_A=10,20"]
    assert main(["sweep", "paper_designed", *vary, *changes]) == 0
    printed = capsys.readouterr().out
    assert "capture range: share of the area approach.offset -80 to 80 mm" in printed
    line = next(line for line in printed.splitlines() if line.startswith("buffer.c_A = 10: "))
    share, error = (float(text) / 100.0 for text in line.split(": ")[1].split()[:3:2])
    scene = load_scene("paper_designed", ["run.t_end=1.5", "buffer.c_A=10", "run.rtol=1e-6"])
    offsets = np.linspace(-0.08, 0.08, 33)
    outcomes = [run_to_end(change_scene(scene, {"approach.offset": x})) for x in offsets]
    captured = [each.captured and not each.left_again for each in outcomes]
    assert 0.0 < np.mean(captured) < 1.0
    assert share == pytest.approx(np.mean(captured), abs=error + 2.0 / 33)
