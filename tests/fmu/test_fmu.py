"""A scene as a unit of FMI 3.0 and as a library in C: another program's runs equal Python's."""

import math
import re
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import fmpy
import numpy as np
import pytest
from cases import cases
from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

from capture_sim import load_scene, scene_names, simulate
from capture_sim.cli import main
from capture_sim.detection.criteria import CaptureState
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.samples import SAMPLE, Phase, columns_of
from capture_sim.fmu.description import write_fmu
from capture_sim.fmu.library import make_unit
from capture_sim.fmu.machine_code import instructions
from capture_sim.hardware.law import TipState, WallLaw, Walls

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "examples"))
from docking_controller import command as docking  # noqa: E402

#: A unit is compiled by itself, and may round other than the kernels of Python; touches enlarge the
#: difference.  1e-9 is the promise.
EQUAL = 1e-9
SCENES = [name for name in scene_names() if not name.startswith("_")]


@pytest.fixture(scope="module")
def unit(tmp_path_factory):
    """A function that returns a scene's unit, made once."""
    folder, made = tmp_path_factory.mktemp("units"), {}

    def path_of(name, changes=()):
        key = f"{name}{dict(changes)}"
        if key not in made:
            made[key] = folder / f"{len(made)}.fmu"
            write_fmu(make_unit(load_scene(name, changes)), made[key])
        return made[key]

    return path_of


class Instance:
    """An instance of a unit, driven by its names."""

    def __init__(self, path, folder, messages, **options):
        description = fmpy.read_model_description(path)
        self.references = {v.name: v.valueReference for v in description.modelVariables}
        self.slave = FMU3Slave(
            guid=options.pop("token", description.guid),
            unzipDirectory=fmpy.extract(path, unzipdir=folder),
            modelIdentifier=description.coSimulation.modelIdentifier,
        )

        def log(_environment, _status, _category, text):
            messages.append(text.decode())

        self.slave.instantiate(logMessage=log, **options)

    def set(self, values):
        for name, value in values.items():
            kind = "Boolean" if isinstance(value, bool) else "Float64"
            getattr(self.slave, f"set{kind}")([self.references[name]], [value])

    def get(self, name, kind="Float64"):
        return getattr(self.slave, f"get{kind}")([self.references[name]])[0]

    def begin(self, **values):
        self.slave.enterInitializationMode()
        self.set(values)
        self.slave.exitInitializationMode()

    def step(self, t, h):
        """Take a step; return its end, and whether it ended at an event and with the run."""
        _, over, early, last = self.slave.doStep(t, h)
        return last, early, over


@pytest.fixture
def instances(tmp_path):
    """A function that makes an instance; its messages are in ``messages`` of the function."""
    made = []

    def make(path, **options):
        made.append(Instance(path, tmp_path / str(len(made)), make.messages, **options))
        return made[-1]

    make.messages = []
    yield make
    for instance in made:
        if instance.slave.component:
            instance.slave.freeInstance()


@contextmanager
def raises(messages, text, error=FMICallException):
    """The call fails, and the unit reports a text."""
    with pytest.raises(error):
        yield
    assert any(text in message for message in messages), messages


@pytest.mark.parametrize("name", cases(few=["tilt_p10", "paper_undamped"], all=SCENES))
def test_a_unit_is_valid_and_equals_the_run_in_python(unit, name):
    """At every communication point, in every output."""
    path = unit(name)
    assert validate_fmu(str(path)) == []
    names = [v.name for v in fmpy.read_model_description(path).modelVariables]
    outputs = [n for n in names if n.partition(".")[0] in SAMPLE.names]
    detected = ["capture_state", "capture_since", "nearest_distance"]
    assert not set(detected) - set(names)
    t_end = min(load_scene(name).run.t_end, 4.0)
    rows = fmpy.simulate_fmu(
        str(path), stop_time=t_end, output_interval=0.004, step_size=0.004, output=outputs
    )
    samples = columns_of(Bench(load_scene(name)).advance(rows["time"]))
    assert len(samples["t"]) == len(rows) > 100
    for output in outputs:
        scale = max(1.0, np.abs(samples[output]).max())
        if "force" in output or "torque" in output:
            scale *= 100.0  # a wall's force rises by 1e5 N in a mm
        assert np.abs(rows[output] - samples[output]).max() <= EQUAL * scale, output


def statuses_of(unit, instances, name, changes):
    """Return the run's last status and, of a unit, what its detector says at each of its times."""
    scene = load_scene(name, changes)
    result = simulate(scene)
    instance = instances(unit(name, changes))
    instance.begin()
    found, t, is_over = [], 0.0, False
    while not is_over:
        row = [instance.get("capture_state", "Int64")]
        found.append((t, *row, instance.get("capture_since"), instance.get("nearest_distance")))
        t, _, is_over = instance.step(t, 1.0 / scene.run.rate)
    return result, found, instance


@pytest.mark.parametrize(
    "name, changes, verdict",
    [
        ("tilt_0", {}, "captured"),
        ("paper_designed", {"run.t_end": 6.0}, "captured"),
        ("paper_case_1", {}, "rebound"),
        ("paper_designed", {"initial.chaser.vx": 0.02, "run.t_end": 0.5}, "undecided"),
        ("paper_designed", {"initial.target.y": 0.4, "run.t_end": 6.0}, "missed"),
    ],
)
def test_the_units_verdict_is_that_of_the_run_at_the_same_time(
    unit, instances, name, changes, verdict
):
    """Status by status, and at the end of a run that had no verdict before.

    The closest approach is located between the samples, which the detector's cannot be below.
    """
    result, found, instance = statuses_of(unit, instances, name, changes)
    *during, last = result.statuses
    assert last.state.label == verdict
    own = np.array([(s.t, int(s.state), s.t - s.time_in_state) for s in during])
    assert np.array(found)[:, :3] == pytest.approx(own[: len(found)], abs=1e-9)
    nearest = np.array([each[3] for each in found])
    sampled = np.array([s.nearest_distance for s in during])[: len(found)]
    assert (np.diff(nearest) <= 1e-9).all()
    assert (nearest <= sampled + 1e-9).all()
    located = result.summary["nearest_distance"]
    assert instance.get("nearest_distance") == pytest.approx(located, abs=1e-9)
    assert len(found) >= len(own) - 1
    assert instance.get("capture_state", "Int64") == int(last.state)
    assert instance.get("capture_since") == pytest.approx(last.t - last.time_in_state, abs=1e-9)


def test_a_step_returns_early_at_each_event(unit, instances):
    instance = instances(unit("tilt_0"), earlyReturnAllowed=True)
    instance.begin()
    t, found = 0.0, []
    while t < 3.0:
        t, is_early, _ = instance.step(t, 0.1)
        found += [t] * is_early
    events = [event.t for event in simulate("tilt_0").events if 0.0 < event.t < 3.0]
    assert len(found) > 10
    # compiled apart, they round differently, and each touch enlarges that: 2e-12 s after twenty
    assert found == pytest.approx(np.unique(events).tolist(), abs=1e-10)


def test_the_run_ends_where_its_scene_ends(unit, instances):
    """That is between two communication points, some time after the latch has closed."""
    instance = instances(unit("tilt_0"))
    instance.begin()
    result, t, is_over = simulate("tilt_0"), 0.0, False
    while not is_over:
        t, _, is_over = instance.step(t, 0.7)
    assert t == pytest.approx(result.events[-1].t, abs=EQUAL)
    assert instance.get("q.x_S") == pytest.approx(result.events[-1].q[0], abs=EQUAL)


@pytest.mark.parametrize(
    "name, changes",
    [
        ("tilt_p10", {"buffer.k_A": 620.0, "buffer.c_A": 21.0, "friction.mu": 0.2}),
        ("tilt_p10", {"buffer.c_A_rebound": 30.0, "buffer.c_A": 21.0}),  # whatever the order
        ("tilt_0", {"buffer.k_A3": 2e5, "buffer.c_T2": 0.3, "latch.damping": 12.0}),
        (
            "paper_designed",
            {"initial.chaser.vy": 0.003, "initial.target.theta": 0.02, "initial.chaser.theta": 0.01}
            | {"contact.hysteresis_factor": 0.4},
        ),
    ],
)
def test_parameters_are_those_of_the_scene(unit, instances, name, changes):
    """Up to the error of the integration, whose scale is that of the exported scene."""
    instance = instances(unit(name))
    instance.begin(**changes)
    t_end = 3.2 if name.startswith("tilt") else 0.4
    t = 0.0
    while t < t_end - 1e-9:
        t, _, _ = instance.step(t, 0.1)
    own = Bench(load_scene(name, changes)).advance([t])[0]
    unchanged = Bench(load_scene(name)).advance([t])[0]
    assert instance.get("q.x_T") == pytest.approx(own["q"][5], abs=1e-9)
    assert abs(unchanged["q"][5] - own["q"][5]) > 1e-5


WRENCH = ("wrench.force.x", "wrench.force.y", "wrench.torque.z")


def driven(instance, scene, n, step=1e-3):
    """Move a unit and a bench n steps under the wrench of a plate; return both ends and the time.

    The wrench is that of an elastic wall where the bench's tip is.
    """
    bench, walls, t = Bench(scene), Walls(scene), 0.0
    bench.set_contact(0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    bench.drive_tip((0.0, 0.0, 0.0), t)
    sample = bench.advance([t])[-1]
    for _ in range(n):
        tip = TipState(t, -sample["tip_axial"], sample["tip_lateral"], 0.0, 0.0, 0.0, 0.0)
        wrench = walls.wrench(WallLaw(2e4), tip)
        given = (wrench.fx, wrench.fy, 1e-3 * wrench.fx)
        instance.set(dict(zip(WRENCH, given, strict=True)))
        bench.drive_tip(given, t + step)
        sample = bench.advance([t + step])[-1]
        t, _, _ = instance.step(t, step)
    return sample, t


def test_a_wrench_from_outside_moves_the_unit_as_the_bench(unit, instances):
    """A plate, off the axis: through the touch, in every output."""
    instance = instances(unit("_loop"))
    instance.begin(contact_outside=True)
    sample, _ = driven(instance, load_scene("_loop"), 300)
    for name, value in columns_of(np.array([sample])).items():
        kind = "Int64" if name in ("phase", "walls", "at_rest", "touches") else "Float64"
        if name != "t":
            assert instance.get(name, kind) == pytest.approx(value[0], rel=EQUAL, abs=EQUAL), name
    assert instance.get("capture_state", "Int64") == CaptureState.CONTACT
    assert sample["v"][0] < 0.09  # of 0.1 m/s


def test_thrust_moves_the_unit_as_the_bench_to_its_end(unit, instances):
    """Wrenches on both vehicles that change every 50 ms, through touches, in some outputs."""
    limits = {"force": 5.0, "torque": 1.0}
    changes = {"thrusters": {"chaser": limits, "target": limits}, "run.t_end": 0.52}
    instance = instances(unit("paper_designed", changes))
    instance.begin()
    bench, t, is_over = Bench(load_scene("paper_designed", changes)), 0.0, False
    names = [f"thrust.{v}.{n}" for v in ("chaser", "target") for n in ("force.x", "force.y")]
    while not is_over:
        force = [math.cos(7 * t), math.sin(5 * t), -0.5, 0.2 * math.cos(t)]
        instance.set(dict(zip(names, force, strict=True)))
        until = min(t + 0.05, 0.52)
        bench.thrust((*force[:2], 0.0), (*force[2:], 0.0), until)
        sample = bench.advance([until])[-1]
        t, _, is_over = instance.step(t, 0.05)
        for name in ("q.x_S", "q.y_T", "v.theta_P", "work_thrust", "thrust.target_y"):
            value = columns_of(np.array([sample]))[name][0]
            assert instance.get(name) == pytest.approx(value, abs=1e-7), name
    assert t == pytest.approx(0.52)
    assert sample["touches"] > 3


@pytest.mark.parametrize("speed", [0.0, 0.1])
def test_the_free_flyer_is_flown_by_its_controller_as_in_python(speed, unit, instances):
    """From rest, and with a speed that only the host gives it; through the docking."""
    example = ROOT / "examples" / "free_flyer.yaml"
    changes = {"run.t_end": 8.0}
    instance = instances(unit(example, changes))
    instance.begin(**{"initial.chaser.vx": speed})
    bench = Bench(load_scene(example, {**changes, "initial.chaser.vx": speed}))
    names = [f"thrust.chaser.{n}" for n in ("force.x", "force.y", "torque.z")]
    bench.pause_at(0.0)
    sample, t, is_over, touched = bench.advance([0.0])[0], 0.0, False, False
    while not is_over:
        touched = touched or bool(sample["touches"])
        bodies = [_as_odometry(sample, at) for at in (0, 5)]
        force = docking(*bodies, touched)
        force = [float(np.clip(f, -high, high)) for f, high in zip(force, (2, 2, 0.2), strict=True)]
        instance.set(dict(zip(names, force, strict=True)))
        until = round(t + 0.02, 9)
        bench.thrust(force, (0.0, 0.0, 0.0), until)
        found = bench.advance([until])
        t, _, is_over = instance.step(t, 0.02)
        if not found.size:  # the run has ended after the latch
            assert is_over
            break
        sample = found[-1]
        for name in ("q.x_S", "q.y_S", "v.x_S", "q.x_T"):
            value = columns_of(np.array([sample]))[name][0]
            assert instance.get(name) == pytest.approx(value, abs=EQUAL), (name, t)
    assert touched
    assert instance.get("phase", "Int64") == Phase.LATCHED


def _as_odometry(sample, at):
    heading = sample["q"][at + 2]
    c, s = math.cos(heading), math.sin(heading)
    u, v, spin = sample["v"][at : at + 3]
    half = math.sin(0.5 * heading), math.cos(0.5 * heading)
    return (*sample["q"][at : at + 2], *half, c * u + s * v, c * v - s * u, spin)


def test_a_unit_with_the_contact_outside_has_no_walls_and_ends_after_its_latch(unit, instances):
    """Pressed on by 2 N, the tip goes through where the walls were, and is caught."""
    changes = {"run.after_latch": 0.3, "initial.target.y": 0.0, "friction.law": "none"}
    changes["latch"] = {"radius": 0.003, "stiffness": 2e4, "damping": 80.0}
    instance = instances(unit("paper_designed", changes))
    instance.begin(contact_outside=True)
    t, is_over = 0.0, False
    while not is_over:
        instance.set({"wrench.force.x": 2.0})
        t, _, is_over = instance.step(t, 0.03)
        assert instance.get("touches", "Int64") == 0
        latched = instance.get("phase", "Int64") == Phase.LATCHED
    assert latched
    assert instance.get("capture_state", "Int64") == CaptureState.CAPTURED
    other = instances(unit("paper_designed", changes), earlyReturnAllowed=True)
    other.begin(contact_outside=True, **{"wrench.force.x": 2.0})
    end, events, is_over = 0.0, [], False
    while not is_over:
        end, is_early, is_over = other.step(end, 10.0)
        events += [end] * is_early
    assert end == pytest.approx(events[-1] + 0.3, abs=1e-9)
    assert t == pytest.approx(end, abs=1e-6)


def test_inputs_that_cannot_act_are_reported(unit, instances):
    assert "contact_outside" not in instances(unit("tilt_0")).references  # on its supports
    inside = instances(unit("_loop"))
    with raises(instances.messages, "wrench.force.y = nan N: must be finite"):
        inside.set({"wrench.force.y": float("nan")})
    with raises(instances.messages, "no Boolean of this unit"):
        inside.set({"wrench.force.x": True})
    inside.begin()
    with raises(instances.messages, "contact_outside = 1 1: must be set before the release"):
        inside.set({"contact_outside": True})
    inside.set({"wrench.force.x": 3.0})
    with raises(instances.messages, "wrench.force.x = 3 N: must be 0 unless contact_outside"):
        inside.step(0.0, 0.1)


def test_two_instances_do_not_disturb_each_other(unit, instances):
    one, other = (instances(unit(name)) for name in ("tilt_0", "tilt_p10"))
    one.begin()
    other.begin(**{"buffer.c_A": 25.0})
    t = 0.0
    while t < 3.0:
        one.step(t, 0.25)
        t, _, _ = other.step(t, 0.25)
    for instance, name, changes in ((one, "tilt_0", {}), (other, "tilt_p10", {"buffer.c_A": 25.0})):
        alone = Bench(load_scene(name, changes)).advance([t])[0]
        assert instance.get("tip_axial") == pytest.approx(alone["tip_axial"], abs=EQUAL)


def test_a_state_that_was_kept_continues_in_another_instance(unit, instances):
    one, other = instances(unit("tilt_m10")), instances(unit("tilt_m10"))
    one.begin()
    one.step(0.0, 2.75)  # between two touches
    kept = one.slave.serializeFMUState(one.slave.getFMUState())
    one.step(2.75, 0.5)
    other.slave.setFMUState(other.slave.deserializeFMUState(kept))
    other.step(2.75, 0.5)
    assert other.get("impulse.+y") == one.get("impulse.+y") > 0.0


def test_a_state_has_the_inputs_and_the_detector(unit, instances):
    """Kept in the middle of a touch; the other instance has had none and its contact inside."""
    one, other = (instances(unit("_loop")) for _ in range(2))
    one.begin(contact_outside=True)
    other.begin()
    _, t = driven(one, load_scene("_loop"), 70)
    kept = one.slave.serializeFMUState(one.slave.getFMUState())
    other.slave.setFMUState(other.slave.deserializeFMUState(kept))
    for instance in (one, other):
        instance.step(t, 0.05)
    assert one.get("wrench.force.x") == other.get("wrench.force.x") < 0.0
    for name in ("q.x_T", "v.x_S", "capture_since", "nearest_distance"):
        assert other.get(name) == one.get(name)
    assert one.get("capture_since") > 0.0


def test_wrong_use_is_reported_with_value_unit_and_range(unit, instances):
    instance = instances(unit("tilt_0"))
    instance.slave.enterInitializationMode()
    for name, value, text in (
        ("buffer.k_A", -5.0, "buffer.k_A = -5 N/m: must be >"),
        ("buffer.c_A", float("nan"), "buffer.c_A = nan N s/m: must be >= 0"),
        ("friction.mu", float("inf"), "friction.mu = inf 1: must be >= 0"),
        ("tip_axial", 0.1, "not a parameter or input"),
    ):
        with raises(instances.messages, text):
            instance.set({name: value})
    instance.slave.exitInitializationMode()
    with raises(instances.messages, "must be set before the release"):
        instance.set({"buffer.k_A": 600.0})
    with raises(instances.messages, "communicationStepSize = 0 s: must be > 0"):
        instance.step(0.0, 0.0)
    with raises(instances.messages, "currentCommunicationPoint = 0.5 s: must be 0"):
        instance.step(0.5, 0.1)
    # FMPy raises a bare Exception for an instance that it does not get
    with raises(instances.messages, "instantiationToken", error=Exception):
        instances(unit("tilt_0"), token="another")


def test_a_run_that_cannot_continue_says_why(tmp_path, instances):
    path = tmp_path / "soft.fmu"
    changes = {"initial.chaser.vx": 3.0, "stops": None, "buffer.k_A": 10.0, "buffer.c_A": 0.0}
    write_fmu(make_unit(load_scene("paper_designed", changes)), path)
    instance = instances(path)
    instance.begin()
    with raises(instances.messages, "the probe is pushed in up to its tip"):
        instance.step(0.0, 1.0)


@pytest.mark.long
def test_the_portable_unit_needs_no_special_instructions(tmp_path):
    assert instructions(portable=True) == ()
    unit = make_unit(load_scene("tilt_0"), portable=True)
    assert "CS_NEEDS" not in unit.header
    write_fmu(unit, tmp_path / "portable.fmu")
    row = fmpy.simulate_fmu(
        str(tmp_path / "portable.fmu"), stop_time=2.8, step_size=0.1, output=["q.x_S"]
    )[-1]
    own = Bench(load_scene("tilt_0")).advance([row["time"]])[0]
    assert row["q.x_S"] == pytest.approx(own["q"][0], abs=1e-10)


def test_the_library_runs_in_a_program_in_c_and_allocates_nothing(tmp_path):
    """The program is the one of the page."""
    assert main(["fmu", "tilt_0", "--c", str(tmp_path)]) == 0
    library = tmp_path / "libtilt_0.so"
    listing = ["nm", "-D", "--undefined-only", library]
    needed = subprocess.run(listing, capture_output=True, text=True, check=True).stdout
    symbols = set(re.findall(r"U (\w+)", needed))
    assert {"pow", "memcpy"} <= symbols
    assert not {s for s in symbols if re.match(r"(m|c|re)alloc|free|Py|_Py|NRT|numba", s)}
    t, x, force = host_of_the_page("host.c", "tilt_0", tmp_path)
    own = Bench(load_scene("tilt_0")).advance([t])[0]
    assert x == pytest.approx(own["q"][0], abs=1e-9)  # as printed
    assert force >= 0.0


def host_of_the_page(name, scene, folder):
    """Compile and run a program of the page with a library in a folder; return its numbers."""
    page = (ROOT / "docs" / "fmu.md").read_text()
    [source] = re.findall(rf'^```c title="{name}"\n(.*?)^```', page, re.MULTILINE | re.DOTALL)
    (folder / name).write_text(source)
    build = ["cc", "-Wall", "-Werror", "-o", "host", name, "-L.", f"-l{scene}", "-Wl,-rpath,."]
    subprocess.run(build, cwd=folder, check=True)
    done = subprocess.run(["./host"], cwd=folder, capture_output=True, text=True, check=True)
    return map(float, done.stdout.partition(": ")[2].split())


def test_the_contact_may_be_in_the_program_in_c(tmp_path):
    """That of the page is an elastic wall, felt a step late: the tip comes back."""
    assert main(["fmu", "_loop", "--c", str(tmp_path)]) == 0
    t, axial, verdict = host_of_the_page("rig.c", "_loop", tmp_path)
    assert t == 1.0
    # back from the wall at 0.1 m/s, after 5 mm of way and a touch of pi sqrt(m / k)
    assert axial == pytest.approx(0.015 + 0.1 * (1.0 - 0.05 - 0.235), abs=0.005)
    assert verdict == CaptureState.REBOUND


def test_a_name_without_suffix_gets_one(tmp_path, capsys):
    """FMI tools open no other file."""
    for name, written in (("unit", "unit.fmu"), ("unit.v1", "unit.v1.fmu")):
        assert main(["fmu", "tilt_0", "--out", str(tmp_path / name)]) == 0
        assert f"written to {tmp_path / written}, as FMI tools" in capsys.readouterr().out
        assert fmpy.read_model_description(tmp_path / written).fmiVersion == "3.0"
    assert {path.name for path in tmp_path.iterdir()} == {"unit.fmu", "unit.v1.fmu"}


def test_bad_arguments_are_reported_in_one_line(tmp_path, capsys):
    assert main(["fmu", "tilt_0", "--out", str(tmp_path / "no" / "x.fmu")]) == 2
    assert main(["fmu", "tilt_0", "--set", "buffer.k_A=-1", "--out", str(tmp_path / "x")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2
    assert not list(tmp_path.iterdir())
