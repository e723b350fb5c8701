"""Every plot against its stored image, as small as its main features allow.

    .venv/bin/python -m tests.viewing.test_plots        # store the images again, after a look

The images are compared in blocks, so that another version of matplotlib's text passes and a curve,
body or panel that is missing, moved or of another colour does not.
"""

from __future__ import annotations

import io
import sys
import warnings
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from cases import cases
from matplotlib.contour import QuadContourSet
from PIL import Image

import capture_sim
from capture_sim.errors import RecordingError
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.studies.vary.inputs import Input
from capture_sim.viewing import figures, plots
from capture_sim.viewing.canvas import save
from capture_sim.viewing.shapes import tip_in_cone
from capture_sim.viewing.source import every_touch, time_window
from capture_sim.viewing.sweep import draw_map, draw_tornado
from tools.explain import draw_geometry

FOLDER = Path(__file__).parent / "images"
DPI = 30
BLOCK = 6  # pixels
#: Largest difference of a block's mean, of 1.  Text of another version of FreeType: below 0.1.
TOLERANCE = 0.15


ODD_RUNS = {
    "one sample": ("tilt_0", {"run.t_end": 5e-4}),
    **cases(
        few={},
        all={
            "at rest": ("paper_designed", {"initial.chaser.vx": 0, "run.t_end": 0.5}),
            "no touch": ("tilt_0", {"run.t_end": 1.0}),
            "verdict before the touch": ("tilt_0", {"detector.capture_radius": 1}),
        },
    ),
}


@cache
def run(name):
    return capture_sim.simulate(name)


def tilts():
    return [run(name) for name in ("tilt_0", "tilt_p10", "tilt_m10")]


def undamped():
    return run("paper_undamped")


#: By name of the image: no long run's end, which depends on a processor's round-off error.  Single
#: quantities are in the sheet.
PICTURES = {
    "run": lambda: plots.draw_run(run("tilt_p10")),
    "overview": lambda: plots.draw_overview(tilts()),
    "sheet": lambda: plots.plot(*tilts(), labels=["a", "b", "c"]),
    "many": lambda: plots.plot(*tilts() * 4),
    "trajectory": lambda: figures.trajectory(tilts()),
    "velocities": lambda: figures.velocities(tilts(), window=(2.5, 3.2)),
    "load_stroke": lambda: figures.load_stroke(tilts()),
    "energies": lambda: figures.energies(tilts()),
    "snapshots": lambda: figures.snapshots(run("tilt_p10"), count=4),
    "geometry": lambda: draw_geometry(capture_sim.load_scene("tilt_0")),
}


def drawn(figure):
    """Return a figure as a small image of 32 colours."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DPI)
    return Image.open(file).convert("RGB").quantize(32, dither=Image.Dither.NONE)


def blocks(image):
    """Return the means of an image over blocks, (m, n, 3), 0 to 1."""
    pixels = np.asarray(image.convert("RGB"), float) / 255.0
    rows, columns = (size // BLOCK * BLOCK for size in pixels.shape[:2])
    shape = (rows // BLOCK, BLOCK, columns // BLOCK, BLOCK, 3)
    return pixels[:rows, :columns].reshape(shape).mean(axis=(1, 3))


@pytest.mark.parametrize("name", PICTURES)
def test_plot_is_as_its_stored_image(name):
    figure = PICTURES[name]()
    for axes in figure.axes:
        assert all("[" in text for text in (axes.get_xlabel(), axes.get_ylabel()) if text)
    with Image.open(FOLDER / f"{name}.png") as stored:
        now, then = drawn(figure), stored.convert("RGB")
        assert now.size == then.size
        assert np.abs(blocks(now) - blocks(then)).max() < TOLERANCE


@pytest.mark.parametrize(
    "name, other",
    [
        ("sheet", lambda: plots.plot(*tilts()[:2], labels=["a", "b"])),
        ("run", lambda: plots.draw_run(run("tilt_m10"))),
        ("trajectory", lambda: figures.trajectory(tilts()[::-1])),
        ("energies", lambda: figures.energies([tilts()[0]] * 3)),
    ],
)
def test_another_plot_is_not_taken_for_the_stored_one(name, other):
    with Image.open(FOLDER / f"{name}.png") as stored:
        a, b = blocks(drawn(other())), blocks(stored)
    assert a.shape != b.shape or np.abs(a - b).max() > TOLERANCE


def test_a_run_and_its_recording_give_one_picture_and_the_files_are_reproducible(tmp_path):
    recorded = read_run(write_run(run("tilt_p10"), tmp_path / "run.mcap"))
    paths = [[tmp_path / f"{name}{end}" for end in (".svg", ".png")] for name in "ab"]
    for each, files in zip((run("tilt_p10"), recorded), paths, strict=True):
        assert save(plots.draw_run(each), *files) == files[-1]
    for one, other in zip(*paths, strict=True):
        assert one.read_bytes() == other.read_bytes()


def test_a_run_that_misses_shows_its_path_and_where_it_was_closest():
    missed = capture_sim.simulate("paper_designed", {"initial.target.y": 0.15})
    _, cone, force, *_ = plots.draw_run(missed).axes
    (low, high), place = cone.get_ylim(), plots.key_moments(missed)[0].place
    assert low < 1e3 * place[1] < high
    lengths = [np.ptp(line.get_xdata()) for line in cone.lines if len(line.get_xdata())]
    assert max(lengths) > 200.0  # its path, mm
    assert force.get_title() == "Contact force: no touch"
    ended = capture_sim.simulate("tilt_0", {"run.t_end": 1.0})
    assert "undecided, ended before a contact" in plots.draw_run(ended).get_suptitle()


def test_located_peaks_are_marked_on_the_force(tmp_path):
    force = plots.draw_run(undamped()).axes[2]
    touches = undamped().touches
    lines = [line for line in force.get_lines() if "touch" in str(line.get_label())]
    assert sorted(y for line in lines for y in line.get_ydata()) == sorted(touches["peak_force"])
    low, high = force.get_ylim()
    assert low < touches["peak_force"].min() < touches["peak_force"].max() < high


@pytest.mark.parametrize("scene, changes", ODD_RUNS.values(), ids=ODD_RUNS)
def test_odd_runs_are_drawn_without_a_warning(scene, changes):
    odd = capture_sim.simulate(scene, changes)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plots.draw_run(odd).draw_without_rendering()
        for picture in figures.pictures_of(odd):
            picture.draw().draw_without_rendering()
        for window in ((0.2, 0.4), (5.5, 5.6)):
            figures.velocities(odd, window=window).draw_without_rendering()


def test_a_touch_in_which_the_run_ended_is_drawn_to_its_end():
    whole = run("tilt_0")
    longest = whole.touches[np.argmax(whole.touches["end"] - whole.touches["start"])]
    until = 0.5 * (longest["start"] + longest["end"])
    ended = whole.replaced(
        samples=whole.samples[whole.samples["t"] <= until],
        touches=whole.touches[whole.touches["end"] <= until],
        events=[event for event in whole.events if event.t <= until],
        statuses=[status for status in whole.statuses if status.t <= until],
    )
    last = ended.samples["t"][-1]
    unfinished = every_touch(ended)[-1]
    assert unfinished[["start", "end"]].tolist() == (longest["start"], last)
    during = ended.samples["t"] >= longest["start"]
    assert unfinished["peak_force"] == ended.samples["normal_force"][during].max() > 0.0
    assert time_window(ended)[1] == last
    assert len(every_touch(whole)) == len(whole.touches)
    force = plots.draw_run(ended).axes[2]
    shaded = force.collections[-1].get_paths()[-1].get_extents()
    assert (shaded.x0, shaded.x1) == pytest.approx((longest["start"], last))


@pytest.mark.parametrize("name, is_near", [("paper_undamped", False), ("paper_designed", True)])
def test_the_end_of_a_path_is_marked_where_it_can_be_seen(name, is_near):
    [axes] = figures.trajectory(run(name)).axes
    assert bool(axes.child_axes) is is_near  # the surroundings of BE, enlarged
    for each in axes.child_axes or [axes]:
        marks = [line.get_xydata() for line in each.get_lines() if line.get_marker() == "o"]
        end = tip_in_cone(run(name).samples)[-1] * 1e3
        assert any(mark.tolist() == [end.tolist()] for mark in marks)


def test_an_unwritable_folder_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot write"):
        save(figures.trajectory(run("tilt_0")), tmp_path / "file" / "x.png")


def test_plot_names_what_is_no_run():
    with pytest.raises(TypeError, match="must be runs, one argument each"):
        capture_sim.plot([run("tilt_0")])


def test_a_map_has_no_contours_around_single_runs():
    """A plane of forces with a spike and a corner without touches: only lines across the plane."""
    at = np.arange(12.0)
    table = pd.DataFrame([{"a": a, "b": b} for a in at for b in at])
    table["max_normal_force"] = 100.0 + 10.0 * table["a"]
    table.loc[(table["a"] == 5.0) & (table["b"] == 5.0), "max_normal_force"] = 500.0
    table.loc[(table["a"] > 8.0) & (table["b"] > 8.0), "max_normal_force"] = 0.0
    table["outcome"] = table["verdict"] = "captured"
    axes = [Input(name, "1", tuple(at)) for name in ("a", "b")]
    [panel] = draw_map(table, axes, "plane").axes
    [lines] = [each for each in panel.collections if isinstance(each, QuadContourSet)]
    pieces = [piece for path in lines.get_paths() for piece in path.to_polygons(closed_only=False)]
    assert pieces
    assert all(np.ptp(piece, axis=0).max() > 2.0 for piece in pieces)


def test_the_strongest_input_of_a_tornado_is_at_the_top_of_every_panel():
    table = pd.DataFrame({"verdict": ["captured"] * 3})
    correlations = {"max_normal_force": [0.2, -0.9, 0.5], "captured": [0.1, 0.3, -0.6]}
    found = pd.DataFrame(correlations, index=["k", "c", "mass"])
    first, second = draw_tornado(table, found, "bench").axes
    assert [text.get_text() for text in first.get_yticklabels()] == ["c", "mass", "k"]
    low, high = first.get_ylim()
    assert low > high  # the first is the highest
    assert [bar.get_width() for bar in first.patches] == [-0.9, 0.5, 0.2]
    assert [bar.get_width() for bar in second.patches] == [0.3, -0.6, 0.1]


def main():
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or PICTURES:
        drawn(PICTURES[name]()).save(FOLDER / f"{name}.png", optimize=True)
        print(FOLDER / f"{name}.png")


if __name__ == "__main__":
    main()
