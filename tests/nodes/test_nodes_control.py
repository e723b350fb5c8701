"""Play, pause, step, reset and launch, over real DDS; one test for each rule."""

import time

import pytest
from bench_processes import Client, Simulation, processes, wait_until
from forked import Forked
from std_srvs.srv import Trigger

from capture_sim import load_scene, simulate
from capture_sim.control.simulation import Code, State
from capture_sim.messages.topics import LAUNCH_COMMAND, LAUNCHER_PHASE
from capture_sim.nodes.node import message_class
from capture_sim.nodes.services import FEATURES

OVERRIDES = ["run.t_end=0.4"]


@pytest.fixture(scope="module")
def nodes(tmp_path_factory):
    """Simulator, stopped, and launcher; they serve all tests here."""
    with processes(Forked) as start:
        yield {
            "simulator": start(
                "simulator",
                consumers="[launcher]",
                initial_state="stopped",
                overrides=str(OVERRIDES),
                exit_when_done="false",
            ),
            "launcher": start("launcher", exit_when_done="false"),
        }


@pytest.fixture(scope="module")
def simulation(nodes):
    with Client() as client:
        yield Simulation(client)


@pytest.fixture
def stopped(simulation):
    simulation.set(State.STOPPED)
    simulation.client.set("simulator", rtf=0.0)
    simulation.client.set("launcher", auto_release=True)
    simulation.settle()
    simulation.states.clear()
    simulation.clock.clear()
    return simulation


@pytest.fixture
def paused(stopped):
    assert stopped.set(State.PAUSED)[0] == Code.OK
    return stopped


def whole():
    return simulate(load_scene("tilt_0", OVERRIDES)).samples


def same(states, samples):
    """Whether messages hold the samples' own bits."""
    return all(
        (m.t, m.q.tobytes(), m.v.tobytes(), m.axial_force, m.energy_residual)
        == (s["t"], s["q"].tobytes(), s["v"].tobytes(), s["axial_force"], s["energy_residual"])
        for m, s in zip(states, samples, strict=True)
    )


def test_features_are_those_that_work(simulation):
    features = simulation.features()
    assert sorted(features.features) == sorted(FEATURES.values())
    for name, number in FEATURES.items():
        assert getattr(type(features), name) == number
    assert list(features.spawn_formats) == []


def test_stopped_sends_nothing_and_playing_runs_to_the_end(stopped):
    assert stopped.state is State.STOPPED
    assert stopped.settle() == 0
    assert stopped.set(State.PLAYING) == (Code.OK, "")
    wait_until(lambda: stopped.state is State.STOPPED)
    assert stopped.settle() == 401
    assert same(stopped.states, whole())


def test_step_sends_its_samples_and_returns_paused(paused):
    assert paused.state is State.PAUSED
    assert paused.settle() == 0
    assert paused.clock == []
    for count in (1, 1, 10, 30):
        before = len(paused.states)
        assert paused.step(count) == (Code.OK, "")
        assert paused.state is State.PAUSED
        assert paused.settle() == before + count
    assert same(paused.states, whole()[:42])
    # 100 Hz of simulated time, from 1 s on: 0, 10, 20, 30, 40 ms
    stamps = [m.clock.sec * 10**9 + m.clock.nanosec for m in paused.clock]
    assert stamps == [10**9 + i * 10**7 for i in range(5)]


def test_step_beyond_the_end_says_how_far_it_came(paused):
    code, text = paused.step(1000)
    assert code == Code.OPERATION_FAILED
    assert "401 of 1000" in text
    assert paused.settle() == 401


def test_step_without_release_says_so(stopped):
    stopped.client.set("launcher", auto_release=False)
    stopped.set(State.PAUSED)
    code, text = stopped.step()
    assert code == Code.OPERATION_FAILED
    assert "no release" in text


def test_pause_holds_and_play_goes_on_without_a_gap(stopped):
    stopped.client.set("simulator", rtf=1.0)
    stopped.set(State.PLAYING)
    wait_until(lambda: len(stopped.states) > 50)
    assert stopped.set(State.PAUSED) == (Code.OK, "")
    held = stopped.settle()
    assert held < 401
    time.sleep(0.3)
    assert len(stopped.states) == held
    began = time.monotonic()
    stopped.set(State.PLAYING)
    wait_until(lambda: len(stopped.states) == 401)
    # the pause is not caught up with: what was left takes its time
    assert time.monotonic() - began > 0.9 * (401 - held) * 1e-3
    assert same(stopped.states, whole())


def test_resets_begin_again_with_the_same_bits(paused):
    reference = whole()[:37]
    for scope in (0, 3, 7, 255) * 8:
        run = paused.runs[-1].run_id
        assert paused.step(37) == (Code.OK, "")
        assert paused.reset(scope) == (Code.OK, "")
        assert paused.runs[-1].run_id != run
    assert paused.state is State.PAUSED  # it stays what it was
    assert paused.settle() == 32 * 37
    for i in range(0, 32 * 37, 37):
        assert [m.seq for m in paused.states[i : i + 37]] == list(range(37))
        assert same(paused.states[i : i + 37], reference)


def test_reset_while_playing_plays_on(stopped):
    stopped.client.set("simulator", rtf=1.0)
    stopped.set(State.PLAYING)
    wait_until(lambda: len(stopped.states) > 20)
    assert stopped.reset() == (Code.OK, "")
    assert stopped.state is State.PLAYING
    wait_until(lambda: stopped.state is State.STOPPED)
    stopped.settle()
    assert same(stopped.states[-401:], whole())


# parameters


def test_experiment_is_changed_while_stopped(stopped):
    wanted = ["run.t_end=0.1", "cone.R_c=0.02"]
    assert stopped.client.set("simulator", scenes=["tilt_p10"], overrides=wanted) == (True, "")
    try:
        stopped.set(State.PLAYING)
        wait_until(lambda: stopped.state is State.STOPPED)
        assert stopped.settle() == 101
        assert stopped.runs[-1].name == "tilt_p10"
        assert same(stopped.states, simulate(load_scene("tilt_p10", wanted)).samples)
    finally:
        assert stopped.client.set("simulator", scenes=["tilt_0"], overrides=OVERRIDES)[0]


@pytest.mark.parametrize(
    "wanted, words",
    [
        ({"scenes": ["tilt_1"]}, "did you mean"),
        ({"scenes": ["tilt_0", "tilt_0"]}, "different names"),
        ({"overrides": ["buffer.c_A=-1"]}, "N s/m: must be >= 0"),
    ],
)
def test_experiment_that_is_none_is_refused(wanted, words, stopped):
    worked, reason = stopped.client.set("simulator", **wanted)
    assert not worked
    assert words in reason


# the launch


def test_launch_again_by_service_after_a_reset(stopped):
    client = stopped.client
    client.set("launcher", auto_release=False)
    stopped.set(State.PLAYING)
    for _ in range(2):
        wait_until(lambda: stopped.runs[-1:] and not stopped.states)
        wait_until(lambda: client.ask(Trigger, "/launcher/launch").success)
        wait_until(lambda: len(stopped.states) > 100)
        again = client.ask(Trigger, "/launcher/launch")
        assert not again.success
        assert "not armed" in again.message or "no run" in again.message
        stopped.set(State.STOPPED)
        stopped.settle()
        stopped.states.clear()
        stopped.set(State.PLAYING)
    stopped.set(State.STOPPED)


def test_launch_without_a_run_is_refused(stopped):
    # the launcher ends the last run in its own time
    wait_until(lambda: "no run" in stopped.client.ask(Trigger, "/launcher/launch").message)
    assert not stopped.client.ask(Trigger, "/launcher/launch").success


def test_abort_ends_the_run_and_stays(stopped):
    commands, states = (stopped.client.listen(t) for t in (LAUNCH_COMMAND, LAUNCHER_PHASE))
    stopped.client.set("simulator", rtf=1.0)
    stopped.set(State.PLAYING)
    wait_until(lambda: len(stopped.states) > 20)
    assert stopped.client.ask(Trigger, "/launcher/abort").success
    wait_until(lambda: stopped.state is State.STOPPED)
    wait_until(lambda: commands and commands[-1].action == 3)
    wait_until(lambda: states and states[-1].state == 5)
    assert states[-1].reason == "asked for"
    # stamped when it was asked for, not at the release, where 1 s of simulated time begins
    for message in (commands[-1], states[-1]):
        t = message.header.stamp.sec - 1 + 1e-9 * message.header.stamp.nanosec
        assert t > 0.01
        # no later than the last state, which may still be under way to this process
        wait_until(lambda t=t: t <= stopped.states[-1].t)


def test_diagnostics_say_how_it_goes(stopped):
    found = []
    kind = message_class("diagnostic_msgs/msg/DiagnosticArray")
    stopped.client.node.create_subscription(kind, "diagnostics", found.append, 10)
    stopped.client.set("simulator", rtf=1.0)
    stopped.set(State.PLAYING)
    wait_until(lambda: stopped.state is State.STOPPED)

    def figures():
        for message in found:
            values = {v.key: v.value for v in message.status[0].values}
            if values.get("figures of") == "the whole run" and values["samples sent"] == "401":
                return values
        return None

    wait_until(figures)
    values = figures()
    assert values["experiment"] == "tilt_0"
    assert int(values["ticks"]) >= 401
    assert float(values["real-time factor achieved"]) > 0.0
    assert float(values["tick lateness p50 [us]"]) <= float(values["tick lateness max [us]"])
    assert abs(float(values["energy residual [J]"])) < 1e-8
    assert values["integrator steps"] == "0"  # on the rail: closed form


def test_description_of_the_bench_is_there_for_latecomers(stopped):
    import xml.etree.ElementTree as ET

    from rclpy.qos import DurabilityPolicy, QoSProfile

    stopped.set(State.PAUSED)
    found = []
    qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    kind = message_class("std_msgs/msg/String")
    stopped.client.node.create_subscription(kind, "robot_description", found.append, qos)
    wait_until(lambda: found)
    links = {link.get("name") for link in ET.fromstring(found[-1].data).iter("link")}
    assert {"chaser/base_link", "target/cone", "chaser/tip"} <= links


@pytest.mark.parametrize("steps", [1, 9, 10, 11, 20])
def test_nobody_waits_for_what_was_made_ahead_of_a_reset(nodes, paused, steps):
    """A tick's messages are made before it is due; those of one that never comes do not count."""
    launcher = nodes["launcher"]
    mark = len(launcher.lines)
    assert paused.step(steps)[0] == Code.OK
    assert paused.reset()[0] == Code.OK
    launcher.wait_for("ended early: reset", since=mark)
    assert "missing" not in "".join(launcher.lines[mark:])
