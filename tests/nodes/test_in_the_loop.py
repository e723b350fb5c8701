"""The loop through its two nodes and DDS.

Where no clock is tested, loop and rig advance in lockstep: a step waits for the answers of the rig
to the one before, however long a busy machine needs for them.
"""

import json
import math
import os
import re
import signal
import time
from pathlib import Path

import pytest
import rclpy
from plate import STEP, ideal_rig
from rclpy.qos import HistoryPolicy, QoSProfile

from capture_sim import load_scene, read_run
from capture_sim.cli import main
from capture_sim.hardware.guard import LoopLimits
from capture_sim.hardware.law import WallLaw, Wrench
from capture_sim.hardware.loop import N_AT_REST, Loop
from capture_sim.hardware.messages import (
    HOLD,
    RIG_TIP,
    TIP,
    TIP_WRENCH,
    stamp_of,
    tip_message,
    wrench_message,
)
from capture_sim.hardware.stage import LoopStage
from capture_sim.messages.convert import Messages
from capture_sim.nodes.base.endpoints import message_class, qos_of
from tests.nodes.bench_processes import Client, Started, fresh, wait_until
from tests.nodes.changes import shared_numbers

PLATE = 2e4  # N/m; a touch from 0.05 to 0.124 s
#: A busy machine does not decide.
PATIENT = {"timeout": 10.0, "lateness_limit": 10.0, "late_share_limit": 1.0}
WIDE = {
    **PATIENT,
    "energy_limit": 1e3,
    "force_limit": 1e6,
    "acceleration_limit": 1e6,
    "depth_limit": 1.0,
}


class Lockstep:
    """A rig and loops of which each step waits for its answers."""

    def __init__(self, start, path):
        self._start, self._path = start, str(path)
        shared_numbers(path)[:] = -math.inf

    def rig(self, **options):
        """Start the rig."""
        return self._start("contact_rig", f"changes.in_lockstep_rig({self._path!r})", **options)

    def loop(self, **options):
        """Run a loop to its end; return its process."""
        options = {"record": "''", **PATIENT, **options}
        change = f"changes.in_lockstep_loop({self._path!r}, node)"
        loop = self._start("loop_simulator", change, **options)
        loop.exit_status = loop.status()
        return loop


@pytest.fixture
def lockstep(start, tmp_path):
    return Lockstep(start, tmp_path / "lockstep")


@pytest.fixture(scope="module")
def plate():
    return load_scene("_loop")


@pytest.fixture
def start(start):
    """As of the other tests; a loop is recorded only where its test says so."""

    def start_node(name, change="", **options):
        if name == "loop_simulator":
            options.setdefault("record", "''")
        return start(name, change, **options)

    return start_node


def test_the_loop_closes_through_dds(lockstep, tmp_path, plate):
    """An ideal rig 2 ms late: what the same latencies give in one process."""
    rig = lockstep.rig(ideal="true", transport_delay=0.002, stiffness=PLATE)
    report = tmp_path / "report.json"
    limits = {**WIDE, "speed_limit": 100.0, "overrides": "[run.t_end=0.25]"}
    loop = lockstep.loop(report=report, **limits)
    assert loop.exit_status == 0, loop.text
    assert rig.end() == 0
    found = json.loads(report.read_text())
    assert found["steps"] == 250
    ages = [round(age / STEP) for age in found["ages"]]
    assert min(ages[5:]) >= 2
    walls = ideal_rig(plate, WallLaw(PLATE))._walls
    limits = LoopLimits(1e3, 1e6, 1e6, 100.0, 1e6, 10.0, depth=1.0)
    loop = Loop(LoopStage(plate, STEP), limits=limits)
    for _ in range(N_AT_REST):
        loop.receive(loop.t, Wrench())
    loop.begin()
    poses, answered = [loop.pose], 0
    for k, age in enumerate(ages):
        if k - age > answered:
            answered = k - age
            pose = poses[answered]
            loop.receive(pose.t, walls.wrench(WallLaw(PLATE), pose))
        poses.append(loop.advance())
    assert found["contacts"][0]["work"] == pytest.approx(loop.episodes[0].work, rel=1e-6)
    assert found["contacts"][0]["work"] > 0.0


def test_a_rig_of_the_real_kind_is_measured_and_held(lockstep, tmp_path):
    """Servo, noise, bias and losses as they are by default; model from half the stiffness."""
    rig = {"servo_bandwidth": 100.0, "servo_delay": 0.001, "damping": 3.0, "wall_offset": 2e-5}
    lockstep.rig(stiffness=2e4, **rig)
    report = tmp_path / "report.json"
    law = {"compensation": "model", "stiffness": 1e4, "exponent": 1.0}
    law["overrides"] = "[run.t_end=0.5]"
    loop = lockstep.loop(report=report, **law)
    assert loop.exit_status == 0, loop.text
    found = json.loads(report.read_text())
    assert found["load_cell"]["bias"][:3] == pytest.approx([0.5] * 3, abs=0.05)
    assert found["load_cell"]["noise"] == pytest.approx(0.1, rel=0.3)
    law = found["law"]
    assert math.log(law["stiffness"] / 2e4) == pytest.approx(0.0, abs=0.02)
    assert law["damping"] == pytest.approx(6e4, rel=0.05)
    assert law["offset"] == pytest.approx(2e-5, abs=1e-5)
    assert found["lag"]["servo"] == pytest.approx(0.0032, abs=0.0015)
    # late, the residual would add 30 mJ: the guard leaves a thousandth of energy_limit, which is
    # two steps of the cell's noise, 0.1 N * 0.1 m/s * 1 ms each
    assert found["energy_excess"] <= 1e-3 * LoopLimits().energy * (1.0 + 1e-6)
    assert found["rig_peak_force"] > 0.0
    assert "not held within 5%" in loop.text  # the first touch had the elastic guess


def test_a_silent_rig_stops_the_vehicles(start):
    rig = start("contact_rig")
    with Client() as client:
        holds, kind = [], message_class(HOLD.type_name)
        client.node.create_subscription(
            kind, HOLD.name, lambda message: holds.append(message.data), qos_of(HOLD)
        )
        patient = {"lateness_limit": 10.0, "late_share_limit": 1.0}
        loop = start("loop_simulator", overrides="[run.t_end=30]", rtf=0.5, **patient)
        loop.wait_for("the loop is closed")
        rig.process.kill()
        assert loop.status() == 1
        wait_until(lambda: len(holds) == 2, "no reason on loop/hold")
        assert holds[0] == ""
        assert "latency of the wrench = " in holds[1]
    assert "latency of the wrench = " in loop.text
    assert "s: must be <= 0.05" in loop.text
    assert "Traceback" not in loop.text


def test_a_stiff_rig_stops_the_vehicles(lockstep):
    lockstep.rig(stiffness=1e8, ideal="true")
    loop = lockstep.loop()
    assert loop.exit_status == 1
    assert "force on the rig = " in loop.text
    assert "N: must be <= 300" in loop.text


def await_steps(tips):
    """Wait until a loop goes: positions at rest all have one stamp."""
    wait_until(lambda: len({stamp_of(tip) for tip in list(tips)}) > 2)


def test_a_step_that_is_late_is_never_caught_up_with(start, tmp_path):
    """The loop's process is stopped for half a second: the run ends that much later, or at once."""
    start("contact_rig", ideal="true")
    found = {}
    report = tmp_path / "report.json"
    for limit, status in ((10.0, 0), (0.05, 1)):
        limits = {**WIDE, "lateness_limit": limit, "report": report}
        with Client() as client:
            sent = client.listen(TIP)
            loop = start("loop_simulator", overrides="[run.t_end=2]", **limits)
            await_steps(sent)
        os.kill(loop.process.pid, signal.SIGSTOP)
        time.sleep(0.5)
        os.kill(loop.process.pid, signal.SIGCONT)
        assert loop.status() == status, loop.text
        found[limit] = json.loads(report.read_text())
    shifted = found[10.0]
    assert shifted["largest_lateness"] >= 0.4
    # by the loop's own clock: all its steps have their time, and what one was late comes on top
    n_steps = shifted["steps"] + 200  # with the run-up
    assert n_steps / shifted["rate"] >= 1e-3 * n_steps + 0.99 * shifted["largest_lateness"]
    assert "lateness of a step = " in loop.text
    assert found[0.05]["largest_lateness"] >= 0.05


@pytest.mark.long
def test_a_reader_that_takes_nothing_does_not_hold_the_loop_up(start):
    """It keeps all, and is never asked for any: 6000 positions, more than DDS holds for it.

    They are sent as fast as the machine can.
    """
    with Client() as client:
        idle = rclpy.create_node("idle", context=client.node.context)
        qos = QoSProfile(depth=1, history=HistoryPolicy.KEEP_ALL)
        idle.create_subscription(message_class(TIP.type_name), TIP.name, print, qos)
        start("contact_rig", ideal="true")
        loop = start("loop_simulator", overrides="[run.t_end=0.4]", rate=10000.0, **WIDE)
        assert loop.status() == 0, loop.text
        idle.destroy_node()


def test_why_a_wrench_cannot_be_used_is_reported(start, client):
    """A rig that stamps by a wall clock."""
    make = Messages()
    kind = message_class(TIP_WRENCH.type_name)
    publisher = client.node.create_publisher(kind, TIP_WRENCH.name, 10)
    after = "changes.begin_after(lambda loop: loop.answers.rejections, node)"
    loop = start("loop_simulator", after, start_timeout=0.1, record="''")
    while loop.is_alive:
        publisher.publish(wrench_message(make, time.time(), Wrench(1.0)))
        time.sleep(0.02)
    assert loop.status() == 1
    assert "answers at rest = 0 within 0.1 s: must be >= 100; rejected:" in loop.text
    assert "stamped by a wall clock" in loop.text


@pytest.mark.long
def test_runs_after_each_other_on_one_rig(lockstep, tmp_path):
    """The first ends in contact, the second finds the law, the third begins with it."""
    lockstep.rig(damping=3.0)
    report = tmp_path / "report.json"
    wall = {"exponent": 1.0, "compensation": "model", "report": report}
    wall["record"] = tmp_path / "runs"
    first = lockstep.loop(overrides="[run.t_end=0.1]", **wall, stiffness=1e3)
    assert first.exit_status == 0, first.text
    second = lockstep.loop(**wall, stiffness=1e3)
    assert second.exit_status == 0, second.text
    found = json.loads(report.read_text())
    assert found["load_cell"]["bias"][:3] == pytest.approx([0.5] * 3, abs=0.05)
    [pasted] = re.findall(r"next law: (.*)", second.text)
    assert pasted == found["next_law"]
    law = dict(re.findall(r"-p (\w+):=(\S+)", pasted))
    names = {name.replace("wall_", ""): float(value) for name, value in law.items()}
    assert names == pytest.approx({name: found["law"][name] for name in names}, rel=1e-8)
    third = lockstep.loop(**{**wall, **law})
    assert third.exit_status == 0, third.text
    assert found["contacts"][0]["is_held"] is False  # by the elastic guess
    on_the_rig = found["contacts"][0]["rig_restitution"]
    found = json.loads(report.read_text())
    assert found["contacts"][0]["restitution"] == pytest.approx(on_the_rig, rel=0.05)
    assert found["contacts"][0]["is_held"] is True
    recorded = tmp_path / "runs" / "_loop_3.mcap"
    assert f"recorded: {recorded}" in third.text
    run = read_run(recorded)
    assert run.problems == ()
    contact = found["contacts"][0]  # of one touch, or more if the residual is late
    assert run.touches["peak_force"].max() == pytest.approx(contact["peak_force"], rel=0.01)
    speed = run.touches["approach_speed"][0]
    assert speed == pytest.approx(contact["approach_speed"], rel=0.01)
    rig = run.to_dataframe("loop/wrench")["wrench.force.x"]
    assert rig.min() == pytest.approx(0.5 - found["rig_peak_force"], rel=0.05)
    assert len(run.to_dataframe("loop/tip")) > 1000  # with the run-up
    first = tmp_path / "runs" / "_loop.mcap"
    compared = ["compare", str(first), str(recorded), "--out", str(tmp_path)]
    assert main(compared) in (0, 1)  # alike or not
    for command in (["view", str(recorded), "--out", str(tmp_path)], ["detect", str(recorded)]):
        assert main(command) == 0
    assert main(["report", str(recorded), "--out", str(tmp_path / "report.html")]) == 0


def test_a_report_that_cannot_be_written_at_the_end_loses_no_summary(start, tmp_path):
    folder = tmp_path / "of_the_report"
    folder.mkdir()
    start("contact_rig", ideal="true")
    limits = {**WIDE, "overrides": "[run.t_end=0.2]", "report": folder / "report.json"}
    loop = start("loop_simulator", **limits)
    loop.wait_for("the loop is closed")
    folder.rmdir()
    assert loop.status() == 1
    assert "200 steps, " in loop.text
    assert "report.json: cannot be written: No such file or directory" in loop.text
    assert "Traceback" not in loop.text


def test_a_tip_that_is_not_at_the_first_position_starts_no_loop(start, client, plate):
    """A rig that answers with the tip where an earlier loop has left it."""
    make = Messages()
    left = LoopStage(plate).tip
    left = left._replace(x=left.x + 0.02)
    after = "changes.begin_after(lambda loop: loop.start_distance > 0.0, node)"
    loop = start("loop_simulator", after, start_timeout=0.5, record="''")
    tips, wrenches = (
        client.node.create_publisher(message_class(topic.type_name), topic.name, 10)
        for topic in (RIG_TIP, TIP_WRENCH)
    )
    while loop.is_alive:
        tips.publish(tip_message(make, -0.2, left))
        wrenches.publish(wrench_message(make, -0.2, Wrench(-18.4)))
        time.sleep(0.02)
    assert loop.status() == 1
    assert "distance of loop/rig_tip from the first position = 30 mm after 0.5 s" in loop.text


@pytest.mark.long
def test_a_restitution_without_contact_on_the_rig_is_reported_as_not_known(lockstep, tmp_path):
    lockstep.rig(wall_offset=-0.005)
    report = tmp_path / "report.json"
    law = {"compensation": "model", "stiffness": 1e4, "exponent": 1.0}
    loop = lockstep.loop(report=report, depth_limit=1.0, **law)
    assert loop.exit_status == 0, loop.text
    assert "first contact: restitution not known" in loop.text
    touch = json.loads(report.read_text())["contacts"][0]
    assert touch["restitution"] is None
    assert touch["is_held"] is None


@pytest.mark.long
def test_the_robot_of_the_example_drives_to_the_start_serves_a_loop_and_holds(start):
    """It also holds when the loop's process is killed: positions stay away."""
    example = Path(__file__).parents[2] / "examples" / "robot_adapter.py"
    code = example.read_text().replace("HEARTBEAT = 0.02", "HEARTBEAT = 1.0")  # a busy machine
    code = code.replace("HOMING_SPEED = 0.05", "HOMING_SPEED = 0.5")
    rig = Started(fresh(code, []))
    wide = {**WIDE, "rtf": 0.2}
    try:
        loop = start("loop_simulator", overrides="[run.t_end=0.04]", **wide)
        assert loop.status() == 0, loop.text
        with Client() as client:
            answered = client.listen(RIG_TIP)
            loop = start("loop_simulator", overrides="[run.t_end=30]", **wide)
            await_steps(answered)  # a position at rest is not missed
            loop.process.kill()
        rig.wait_for("no position for 1 s")
        assert rig.end() == 0
    finally:
        rig.process.kill()
    reasons = re.findall(r"hold: (.*)", rig.text)
    assert reasons == ["end of the run", "no position for 1 s"], rig.text
