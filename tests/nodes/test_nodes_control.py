"""Play, pause, reset and launch, over real DDS; one test for each rule."""

import re
import time

import pytest
from threads import Client, threads, wait_until

from capture_sim import load_scene, simulate
from capture_sim.control.simulation import Code, State
from capture_sim.messages.topics import (
    BENCH_STATE,
    CLOCK,
    RUN_INFO,
)
from capture_sim.nodes.endpoints import message_class
from capture_sim.nodes.services import definitions

OVERRIDES = ["run.t_end=0.4"]


class Simulation:
    """The simulator as a client of simulation_interfaces sees it."""

    def __init__(self, client, namespace=""):
        self.client, self.namespace = client, namespace
        self.runs = client.listen(RUN_INFO, lambda info: info.run_id)
        self.states = client.listen(BENCH_STATE)
        self.clock = client.listen(CLOCK)

    def _ask(self, kind, **fields):
        words = re.sub("(?<!^)(?=[A-Z])", "_", kind).lower()
        return self.client.ask(service(kind), f"{self.namespace}/simulator/{words}", **fields)

    def set(self, state):
        kind = service("SetSimulationState").Request().state.__class__
        result = self._ask("SetSimulationState", state=kind(state=int(state))).result
        return result.result, result.error_message

    @property
    def state(self):
        return State(self._ask("GetSimulationState").state.state)

    def reset(self, scope=0):
        result = self._ask("ResetSimulation", scope=scope).result
        return result.result, result.error_message

    def settle(self):
        """Return how many states have come once no more do."""
        count = -1
        while count != len(self.states):
            count = len(self.states)
            time.sleep(0.1)
        return count


def service(name):
    return getattr(__import__(f"{definitions()}.srv", fromlist=[name]), name)


@pytest.fixture(scope="module")
def nodes():
    """Simulator, stopped, and launcher; they serve all tests here."""
    with threads() as start:
        yield {
            "simulator": start(
                "simulator",
                wait_for="[launcher]",
                initial_state="stopped",
                overrides=str(OVERRIDES),
                exit_when_done="false",
            ),
            "launcher": start("launcher"),
        }


@pytest.fixture(scope="module")
def simulation(nodes):
    with Client() as client:
        yield Simulation(client)


@pytest.fixture
def start_one(nodes):
    """Start a node in a domain's namespace of its own; it is ended with the test."""
    with threads() as start:
        yield lambda name, **parameters: start(name, __ns="/alone", **parameters)


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


def test_stopped_sends_nothing_and_playing_runs_to_the_end(stopped):
    assert stopped.state is State.STOPPED
    assert stopped.settle() == 0
    assert stopped.set(State.PLAYING) == (Code.OK, "")
    wait_until(lambda: stopped.state is State.STOPPED)
    assert stopped.settle() == 401
    assert same(stopped.states, whole())


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


def test_launch_again_by_parameter_after_a_reset(stopped):
    client = stopped.client
    for _ in range(2):
        client.set("launcher", auto_release=False)
        stopped.set(State.PLAYING)
        wait_until(lambda: stopped.runs[-1:] and not stopped.states)
        time.sleep(0.3)
        assert not stopped.states
        assert client.set("launcher", auto_release=True)[0]
        wait_until(lambda: len(stopped.states) > 100)
        stopped.set(State.STOPPED)
        stopped.settle()
        stopped.states.clear()
    client.set("launcher", auto_release=True)


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
            # an earlier, unpaced run has no ticks
            is_whole = values.get("figures of") == "the whole run" and values["ticks"] != "0"
            if is_whole and values["samples sent"] == "401":
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


def test_resets_begin_again_at_once_with_the_same_bits(stopped, nodes):
    """Messages are made before they are due; those of a sample that never comes do not count."""
    stopped.client.set("simulator", rtf=1.0)
    mark = len(nodes["launcher"].lines)
    stopped.set(State.PLAYING)
    for count, scope in enumerate((0, 3, 7, 255), 1):
        wait_until(lambda: len(stopped.states) > 20)
        run = stopped.runs[-1].run_id
        assert stopped.reset(scope) == (Code.OK, "")
        wait_until(lambda run=run: stopped.runs[-1].run_id != run)
        stopped.states.clear()
        nodes["launcher"].wait_for("ended early: reset", since=mark)
        assert nodes["launcher"].text.count("ended early: reset") >= count
    wait_until(lambda: stopped.state is State.STOPPED)
    stopped.settle()
    assert same(stopped.states[-401:], whole())
    assert "missing" not in "".join(nodes["launcher"].lines[mark:])


def test_pause_before_the_release_holds_the_run_at_its_start(paused):
    wait_until(lambda: paused.runs)
    assert paused.settle() == 0
    assert paused.set(State.PLAYING) == (Code.OK, "")
    wait_until(lambda: paused.state is State.STOPPED)
    assert paused.settle() == 401


def test_quitting_ends_the_simulator(start_one):
    with Client() as client:
        node = start_one("simulator", initial_state="stopped", exit_when_done="false")
        services = dict(client.node.get_service_names_and_types())
        assert Simulation(client, "/alone").set(State.QUITTING) == (Code.OK, "")
        assert node.status() == 0
        assert not [name for name in services if "step" in name or "features" in name]


@pytest.mark.parametrize("name", ["/etc/passwd", "../nodes", "no scene:\n  at: all"])
def test_scene_over_the_network_is_a_name_or_text(name, stopped):
    worked, reason = stopped.client.set("simulator", scenes=[name])
    assert not worked
    assert "root:" not in reason
    text = load_scene("tilt_p10", OVERRIDES).to_yaml()
    assert stopped.client.set("simulator", scenes=[text]) == (True, "")
    assert stopped.client.set("simulator", scenes=["tilt_0"]) == (True, "")
