"""A user's controller by name: what it sees, and that it flies each run of a study anew."""

from pathlib import Path

import numpy as np
import pytest

from capture_sim import SceneError, load_scene, simulate, sweep
from capture_sim.cli import main
from capture_sim.dynamics.drive import Control
from capture_sim.run.controllers import Sensed, control_of, measured_control
from capture_sim.studies.evaluate.executors import open_executor

FLYER = {
    "thrusters": {"chaser": {"force": 5.0, "torque": 1.0}},
    "initial.chaser.vx": 0.05,
    "run.t_end": 3.0,
}
CAMERA = {"rate": 50, "latency": 0.05, "dropout": 0.2, "position_noise": 1e-3}
MODULE = """
def make(scene):
    calls = []  # of this run alone

    def command(seen):
        calls.append(seen)
        pose = getattr(seen, "chaser", None)
        push = 0.2 if len(calls) < 100 else 0.0
        return (push, -5.0 * pose[1] if pose else 0.0, 0.0), None

    return command

def fails(scene):
    raise ValueError("no gains")

def number(scene):
    return 3
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module of a user in the present folder; its name."""
    monkeypatch.chdir(tmp_path)
    name = f"my_control_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    return name


def flown(changes, rate=None):
    """Return a run and what its controller has seen."""
    scene, seen = load_scene("paper_designed", FLYER | changes), []

    def command(measured):
        seen.append(measured)
        return (0.02, 0.0, 0.0), None

    return simulate(scene, control=measured_control(scene, command, rate)), seen


def test_a_controller_sees_what_the_recording_has_when_it_has_arrived():
    run, seen = flown({"sensors": {"motion_capture": CAMERA, "load_cell": {}}})
    series = run.series["chaser"]["motion_capture/chaser"]
    cell = run.series["cone_force"]["load_cell/wrench"]
    assert 0.75 < series.t.size / (run.t[-1] * CAMERA["rate"]) < 0.85  # the dropouts
    for measured in seen:
        arrived = np.flatnonzero(series.t + CAMERA["latency"] <= measured.t + 1e-12)
        if not arrived.size:
            assert measured.chaser is None
            continue
        assert measured.stamp == series.t[arrived[-1]]
        assert measured.chaser == tuple(series.values[arrived[-1]])
        force = cell.values[np.flatnonzero(cell.t <= measured.t)[-1]]
        assert measured.wrench[:2] == tuple(-force)
    assert len(seen) == len(np.arange(0, run.t[-1], 0.01))


def test_marker_offset_is_in_the_chasers_axes():
    offset = {"offset_x": 0.01, "offset_y": -0.02, "offset_heading": 0.03}
    exact = {"position_noise": 0.0, "heading_noise": 0.0}
    turned = {"initial.chaser.theta": np.pi / 2}
    run, _ = flown(turned | {"sensors": {"motion_capture": {**exact, **offset}}})
    series = run.series["chaser"]["motion_capture/chaser"]
    assert series.values[0] - run.q[0, :3] == pytest.approx([0.02, 0.01, 0.03], abs=1e-15)


def test_each_run_of_a_sweep_is_flown_anew(module):
    """The same rows for every number of workers, and as single runs."""
    scene = load_scene("paper_designed", FLYER | {"sensors": {"motion_capture": CAMERA}})
    vary = {"sensors.seed": [1, 2, 3], "initial.chaser.y": [0.003, 0.004]}
    tables = []
    for workers in (1, 2):
        with open_executor(workers) as executor:
            tables.append(sweep(scene, vary, control=f"{module}:make", executor=executor))
    assert tables[0].equals(tables[1])
    assert tables[0]["max_normal_force"].nunique() == 6
    for _, row in tables[0].iterrows():
        changes = {name: row[name] for name in vary} | {"run.rtol": 1e-6}
        changed = load_scene(
            "paper_designed", FLYER | {"sensors": {"motion_capture": CAMERA}} | changes
        )
        run = simulate(changed, control=control_of(changed, f"{module}:make"))
        assert run.loads["max_normal_force"] == row["max_normal_force"]


def test_commands_take_a_controller(module, capsys):
    changes = [f"--set={name}={value}" for name, value in FLYER.items() if name != "thrusters"]
    changes.append("--set=thrusters={chaser: {force: 5 N, torque: 1 N m}}")
    given = ["paper_designed", *changes, "--control", f"{module}:make"]
    assert main(["run", *given, "--out", "runs", "--no-record"]) == 0
    table = ["--vary", "initial.chaser.y=3 mm:4 mm:3", "--out", "sweep.csv", "--workers", "1"]
    assert main(["sweep", *given, *table]) == 0
    capsys.readouterr()
    assert main(["sweep", *given, *table, "--resume"]) == 0
    assert "complete: 3 runs" in capsys.readouterr().out
    text = Path("sweep.csv").read_text()
    assert f"--control {module}:make" in text
    assert main(["sweep", *given[:-1], f"{module}:number", *table]) == 2


@pytest.mark.parametrize(
    "name, says",
    [
        ("nothing", r"control = 'nothing': must be module:function"),
        ("no_such_module:make", "cannot be imported: ModuleNotFoundError"),
        ("MODULE:missing", "has no function missing"),
        ("MODULE:fails", "ValueError: no gains"),
        ("MODULE:number", "returned 3: must be a function or a Control"),
    ],
)
def test_what_is_no_controller_is_refused_in_one_line(module, name, says):
    scene = load_scene("paper_designed", FLYER)
    with pytest.raises(SceneError, match=says) as refused:
        control_of(scene, name.replace("MODULE", module))
    assert "\n" not in str(refused.value)
    with pytest.raises(SceneError, match="thrusters: must be in tilt_0"):
        control_of(load_scene("tilt_0"), f"{module}:make")


def test_without_sensors_it_sees_the_exact_sample(module):
    scene = load_scene("paper_designed", FLYER)
    assert isinstance(control_of(scene, f"{module}:make"), Control)
    assert Sensed(0.0).chaser is None
    assert simulate(scene, control=control_of(scene, f"{module}:make")).samples["thrust"].any()
