"""``capture-sim view`` as a user calls it."""

from __future__ import annotations

import os
import shutil

import pytest
import yaml
from bags import of_a_bench
from matplotlib.image import imread

import capture_sim
from capture_sim.cli import main
from capture_sim.commands import output, view
from capture_sim.commands.inputs import load
from capture_sim.commands.recordings import RecordingReader
from capture_sim.recording.offline import write_run
from capture_sim.viewing.figures import pictures_of
from capture_sim.viewing.source import distinct_names


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    scenes = [capture_sim.load_scene(name) for name in ("tilt_0", "tilt_p10")]
    return [
        write_run(capture_sim.simulate(scene), folder / f"{scene.name}.mcap") for scene in scenes
    ]


def test_pictures_of_one_run_leave_an_earlier_overview(recorded, tmp_path):
    pytest.importorskip("rerun", reason="needs rerun")
    path = str(recorded[0])
    (tmp_path / "overview.png").write_text("of earlier runs")
    assert main(["view", path, "--out", str(tmp_path)]) == 0
    assert {file.name for file in tmp_path.iterdir()} == {"tilt_0.png", "runs.rrd", "overview.png"}
    assert (tmp_path / "overview.png").read_text() == "of earlier runs"


def test_plots_and_reports_go_next_to_the_recording(recorded, tmp_path, monkeypatch):
    """Not into the current folder; and what `run` has drawn stays as it is."""
    pytest.importorskip("rerun", reason="needs rerun")
    folder, elsewhere = tmp_path / "runs", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    for path in recorded:
        shutil.copy(path, folder)
    for name in ("tilt_0.png", "overview.png", "runs.rrd"):
        (folder / name).write_text("of earlier runs")
    before = set(folder.iterdir())
    monkeypatch.chdir(elsewhere)
    paths = ["../runs/tilt_0.mcap", "../runs/tilt_p10.mcap"]
    assert [main([command, *paths]) for command in ("view", "compare", "report")] == [0, 0, 0]
    assert not list(elsewhere.iterdir())
    new = {file.name for file in set(folder.iterdir()) - before}
    compared = {"tilt_0_vs_tilt_p10.png", "tilt_0_vs_tilt_p10.html"}
    assert new == {"plots", "report.html", *compared}
    assert (folder / "plots" / "overview.png").is_file()
    for name in ("tilt_0.png", "overview.png", "runs.rrd"):
        assert (folder / name).read_text() == "of earlier runs"


def test_of_a_run_that_was_recorded_again_the_newest_is_shown(recorded, tmp_path, capsys):
    """As after a second `make run`; a file of another run stays, whatever its name."""
    for name, source in (("a", 0), ("a_2", 0), ("a_3", 1), ("b", 0)):
        shutil.copyfile(recorded[source], tmp_path / f"{name}.mcap")
        os.utime(tmp_path / f"{name}.mcap", (1.0, 1.0 if name == "a_2" else 2.0))
    runs = RecordingReader().runs(
        [str(tmp_path / f"{name}.mcap") for name in ("a", "a_2", "a_3", "b")]
    )
    assert [run.name for run in runs] == ["a", "a_3", "b"]
    assert "a_2.mcap: left out" in capsys.readouterr().out


def test_pictures_and_titles_bear_the_recordings_names(recorded, tmp_path, capfd):
    """Two folders with files of the same name, which has blanks."""
    pytest.importorskip("rerun", reason="needs rerun")
    files = [tmp_path / name for name in ("a/tilt_0_3.mcap", "a/my run.mcap", "b/my run.mcap")]
    for file in files:
        file.parent.mkdir(exist_ok=True)
        shutil.copy(recorded[0], file)
    out = tmp_path / "out"
    assert main(["view", *map(str, files[1:]), "--out", str(out)]) == 0
    labels = ["a-my run", "b-my run"]
    assert {file.stem for file in out.glob("*.png")} == {*labels, "overview"}
    assert capfd.readouterr().err == ""  # rerun warns of names that no path of it can have
    assert main(["report", *map(str, files[:2]), "--out", str(tmp_path / "r.html")]) == 0
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    for label in ("tilt_0_3", "my run (tilt_0)"):
        assert f"<p>{label}: captured, impact at" in page


def test_no_number_makes_one_name_anothers():
    names = ["tilt_0", "tilt_0_1", "tilt_0", "tilt_p10"]
    distinct = distinct_names(names)
    assert len(set(distinct)) == 4
    assert distinct[1::2] == names[1::2]


def test_a_plot_of_each_quantity_is_written_as_svg_and_png(recorded, tmp_path, drawn):
    pytest.importorskip("rerun", reason="needs rerun")
    options = ["--figures", "--save", str(tmp_path / "x" / "window.rrd"), "--out", str(tmp_path)]
    window = ["--window", "2.7", "2.9"]
    assert main(["view", str(recorded[0]), *options, *window]) == 0
    assert (tmp_path / "x" / "window.rrd").stat().st_size > 100_000
    names = {file.name for file in (tmp_path / "figures").iterdir()}
    for figure in ("intrusion", "impact_force", "trajectory", "velocities"):
        assert {f"{figure}.svg", f"{figure}.png"} <= names
        assert imread(tmp_path / "figures" / f"{figure}.png").std() > 0.02


def test_bag_of_a_bench_is_drawn_when_its_geometry_is_named(recorded, tmp_path, capsys, drawn):
    bag = str(of_a_bench(recorded[1], tmp_path / "trial.mcap"))
    assert main(["view", bag, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "--scene" in error
    assert main(["view", bag, "--scene", "tilt_0", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "trial.png").stat().st_size > 50_000
    assert main(["report", bag, "--scene", "tilt_0", "--out", str(tmp_path / "r.html")]) == 0
    assert "Not measured: trial" in (tmp_path / "r.html").read_text(encoding="utf-8")


def bag_of(file, folder):
    """A folder as rosbag2 lays it out, of one part that has another name than the folder."""
    folder.mkdir()
    shutil.copy(file, folder / "part_0.mcap")
    told = {"rosbag2_bagfile_information": {"relative_file_paths": ["part_0.mcap"]}}
    (folder / "metadata.yaml").write_text(yaml.safe_dump(told), encoding="utf-8")
    return folder


def test_bags_folder_is_a_recording_to_every_command(recorded, tmp_path, capsys):
    bag = str(bag_of(recorded[1], tmp_path / "bag"))
    assert load(bag, ["friction.mu=0.3"]) == capture_sim.load_scene("tilt_p10", ["friction.mu=0.3"])
    assert main(["report", bag, "--out", str(tmp_path / "r.html")]) == 0
    assert f"recorded in {bag}" in (tmp_path / "r.html").read_text(encoding="utf-8")
    assert main(["run", bag, "--no-record", "--out", str(tmp_path / "runs")]) == 0
    assert "tilt_p10" in capsys.readouterr().out


def test_folder_of_two_trials_is_drawn_and_taken_for_one_by_nothing(recorded, tmp_path, capsys):
    pytest.importorskip("rerun", reason="needs rerun")
    trials = tmp_path / "trials"
    trials.mkdir()
    for file in recorded:
        shutil.copy(file, trials)
    out = tmp_path / "out"
    assert main(["view", str(trials), "--out", str(out)]) == 0
    assert {file.stem for file in out.glob("*.png")} == {"tilt_0", "tilt_p10", "overview"}
    capsys.readouterr()
    for command in (["detect"], ["show"], ["run", "--no-record", "--out", str(out)]):
        assert main([*command, str(trials)]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        for name in ("tilt_0.mcap", "tilt_p10.mcap"):
            assert str(trials / name) in error


def test_file_for_rerun_must_be_named_so(recorded, tmp_path, capsys):
    path = tmp_path / "x.txt"
    assert main(["view", str(recorded[0]), "--save", str(path), "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"capture-sim: --save {path}: must end in .rrd\n"
    assert not any(tmp_path.iterdir())


def test_known_scene_comes_before_a_folder_of_its_name(recorded, tmp_path, monkeypatch):
    bag_of(recorded[1], tmp_path / "tilt_0")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load("tilt_0", []).name == "tilt_0"
    assert load("./tilt_0", []).name == "tilt_p10"
    with pytest.raises(capture_sim.errors.SceneError, match="no scene: must end in"):
        load("empty", [])


@pytest.mark.parametrize(
    "window, said",
    [(("3", "2"), "must be FROM < TO"), (("90", "91"), "no motion from 90 to 91 s")],
)
def test_window_that_cannot_be_is_refused_in_one_line(recorded, tmp_path, capsys, window, said):
    assert main(["view", str(recorded[0]), "--window", *window, "--out", str(tmp_path)]) != 0
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert said in error


def test_figures_and_report_show_how_far_they_are(recorded, tmp_path, capsys, monkeypatch):
    pytest.importorskip("rerun", reason="needs rerun")
    monkeypatch.setattr(output, "_PAUSE", 0.0)
    monkeypatch.setattr(output, "_FIRST_SPEED", 0.0)
    monkeypatch.setattr(view, "pictures_of", lambda *given: pictures_of(*given)[:2])
    monkeypatch.setattr(view, "draw", lambda *_, **__: None)
    path = str(recorded[0])
    assert main(["view", path, "--figures", "--out", str(tmp_path)]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("figures:")]
    assert lines[-1].startswith("figures: 1 of 2 figures, ")
    assert lines[-1].endswith(" s left")
    assert main(["report", path, "--out", str(tmp_path / "r.html")]) == 0
    assert capsys.readouterr().err.splitlines()[-1].startswith("report: 11 of 11 steps, ")
