"""Every command reads every file of the archive, and finds what was found at its time."""

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from cases import cases

from capture_sim.cli import main
from capture_sim.messages.definitions import typestore
from capture_sim.messages.topics import CAPTURE_STATUS, RUN_INFO
from capture_sim.recording.bag import read_bag
from capture_sim.recording.playback import Playback
from capture_sim.recording.read import read_run
from capture_sim.run.summary import FIRST_NAMES

ARCHIVE = Path(__file__).parent
VERSIONS = sorted(path.parent.name for path in ARCHIVE.glob("*/made.json"))
FILES = sorted(path.relative_to(ARCHIVE).as_posix() for path in ARCHIVE.glob("*/*.mcap"))
SIMULATED = [name for name in FILES if not name.endswith("trial.mcap")]
TABLES = sorted(path.relative_to(ARCHIVE).as_posix() for path in ARCHIVE.glob("*/sweep.csv"))

#: Keys of the first results.json, and today's.  `..._latched` is the largest after the latch has
#: closed, which here is that of the whole run.
FIRST_KEYS = {
    **FIRST_NAMES,
    "max_axial_stroke_latched": "max_axial_stroke_in",
    "max_torsion_latched": "max_torsion",
}
#: Difference of coordinates, m and rad, between a file and the same run today.  Kernels round
#: differently on another processor, and those of 8613e21 and 23eac84 are another text of the same
#: equations; the scene's tolerance is 1e-4.
ROUNDED = "1e-6"
#: Keys that a recording has not: how fast it was simulated, by which call, its name.
OF_THE_CALL = ("wall_time", "real_time_factor", "made_by", "recording")


def test_the_archive_is_complete():
    assert {"8613e21", "23eac84", "fc0c3cb", "0.2.0"} <= set(VERSIONS)
    for version in VERSIONS:
        folder = ARCHIVE / version
        names = {path.name for path in folder.iterdir()}
        names_of_all = {"offline.mcap", "nodes.mcap", "trial.mcap", "scene.yaml", "made.json"}
        assert names_of_all | {"offline_results.json", "nodes_results.json", "msg"} <= names
        assert ("sweep.csv" in names) == (version != "8613e21")  # which had no such command
    sizes = [path.stat().st_size for path in ARCHIVE.rglob("*") if path.is_file()]
    assert max(sizes) <= 100 * 1024
    assert sum(sizes) <= 1_500_000


@pytest.mark.parametrize("name", SIMULATED)
def test_results_are_those_of_that_time(name):
    """Verdict, touches, loads and times, to the digits stored."""
    path = ARCHIVE / name
    (expected,) = json.loads(path.with_name(f"{path.stem}_results.json").read_text())
    found = read_run(path).summary
    is_first = "8613e21" in name
    # a recording of a call has no counts of rejected measurements; one of the nodes has them
    absent = (*OF_THE_CALL, "not_used") if path.stem == "offline" else OF_THE_CALL
    for key, value in expected.items():
        if key not in absent:
            assert found[FIRST_KEYS.get(key, key) if is_first else key] == value, key


@pytest.mark.parametrize("name", FILES)
def test_detect_agrees_with_the_detector_of_that_time(name, capsys):
    path = ARCHIVE / name
    made = json.loads((path.parent / "made.json").read_text())
    then = re.search(r"verdict: (\w+)", made["detected"][path.name])[1]
    assert main(["detect", str(path)]) == 0, capsys.readouterr()
    out, err = capsys.readouterr()
    assert re.search(r"verdict: (\w+)", out)[1] == then
    assert out.rstrip().endswith("the same")
    # the rigs of these trials gave their force no frame, which a note says
    notes = [line for line in err.splitlines() if "noted (force_frame_empty)" not in line]
    assert notes == []
    assert read_run(path).statuses[-1].state.label == then


@pytest.mark.parametrize("name", SIMULATED)
def test_a_simulation_of_today_is_close_to_that_of_then(name, tmp_path, capsys):
    """The scene, run again: a step may be rounded differently since, within the tolerance 1e-4."""
    path = ARCHIVE / name
    then = read_run(path)
    assert main(["run", str(path), "--no-record", "--out", str(tmp_path)]) == 0
    (now,) = json.loads((tmp_path / "results.json").read_text())
    assert now["verdict"] == then.verdict
    assert now["first_contact_time"] == pytest.approx(then.summary["first_contact_time"], rel=1e-4)
    assert now["touches"] == then.summary["touches"]
    assert now["max_normal_force"] == pytest.approx(then.summary["max_normal_force"], rel=0.02)


@pytest.mark.parametrize("version", cases(few=["8613e21", VERSIONS[0]], all=VERSIONS))
def test_every_command_takes_the_files_of_a_version(version, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for path in (ARCHIVE / version).glob("*.*"):
        shutil.copy(path, tmp_path)
    simulated, files = ["offline.mcap", "nodes.mcap"], ["offline.mcap", "nodes.mcap", "trial.mcap"]
    commands = [
        ["view", *files, "--out", "view"],
        ["report", *files, "--out", "report.html"],
        ["compare", *simulated],
        ["calibrate", "offline.mcap", "--fit=e", "--restarts=0", "--out=fit"],
        *(["compare", "--simulated", name, "--tolerance", ROUNDED] for name in simulated),
        *(["export", name, "--out", f"tables/{name}"] for name in files),
        *(["show", name] for name in (*simulated, "scene.yaml")),
        ["run", "scene.yaml", "--out", "again"],
    ]
    if Path("sweep.csv").exists():
        commands.append(["sweep", "scene.yaml", "--from", "sweep.csv", "--out", "again/sweep.csv"])
    for command in commands:
        status = main(command)
        out, err = capsys.readouterr()
        assert status == 0, (command, out, err)
        assert "Error" not in err
    assert not list(Path("tables").rglob("*.part"))


@pytest.mark.parametrize("name", SIMULATED)
def test_a_folder_of_that_time_has_one_row_for_each_recording(name, tmp_path, capsys):
    """Its table says nothing of recordings: each row is found to be that of a file."""
    path = ARCHIVE / name
    shutil.copy(path, tmp_path / "every_part.mcap")
    shutil.copy(path.with_name(f"{path.stem}_results.json"), tmp_path / "results.json")
    short = ["tilt_0", "--set", "run.t_end=0.05", "--no-record"]
    assert main(["run", *short, "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "results.json").read_text())
    assert [row["recording"] for row in rows] == ["every_part.mcap", None], capsys.readouterr()


@pytest.mark.parametrize("name", FILES)
def test_what_is_played_are_messages_of_today(name):
    """Every message has today's type and the content of the file's."""
    path, store = ARCHIVE / name, typestore()
    bag = read_bag(path)
    played = {topic: [] for topic in bag.topics}
    for _, topic, data in Playback(path).messages():
        played[topic].append(data)
    for topic, messages in played.items():
        type_name = bag.types[topic]
        decoded = [store.deserialize_cdr(data, type_name) for data in messages]
        then = bag.columns(topic)
        if "seq" in then:
            assert [m.seq for m in decoded] == then["seq"].tolist()
        for field in ("t", "distance", "q", "run_id"):
            if field in then:
                assert all(
                    np.array_equal(getattr(m, field), x)
                    for m, x in zip(decoded, then[field], strict=True)
                )


@pytest.mark.parametrize("name", [FILES[0], FILES[-1]])
@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_truncated_file_of_any_version_is_read_up_to_the_damage(name, share, tmp_path, capsys):
    data = (ARCHIVE / name).read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: math.floor(len(data) * share)])
    bag = read_bag(path)
    assert not bag.complete
    assert bag.columns(RUN_INFO)["run_id"][0]
    for command in (["detect", str(path)], ["export", str(path), "--out", str(tmp_path / "t")]):
        assert main(command) in (0, 1, 2)
        assert "Error" not in capsys.readouterr().err


def test_what_came_later_has_its_default_and_a_name_gives_what_the_file_has():
    bag = read_bag(ARCHIVE / "8613e21" / "offline.mcap")
    assert bag.columns(RUN_INFO)["source"][0] == ""
    assert "source" not in bag.columns("/bench/run_info")
    assert bag.columns(CAPTURE_STATUS)["chaser_rejected"].shape[1] == 6
    assert not read_run(ARCHIVE / "8613e21/offline.mcap").samples["dissipated_slide"].any()
