"""Play, pause, reset and launch, over real DDS; one test for each rule."""

import os
import time
import xml.etree.ElementTree as ET

import pytest

from capture_sim import load_scene, simulate
from capture_sim.base.resources import config_dir
from capture_sim.messages.topics import BENCH_STATE
from capture_sim.nodes.base.endpoints import TRANSIENT_LOCAL
from capture_sim.nodes.simulation.control import Code, State
from tests.nodes.bench_client import Client, Simulation, wait_until
from tests.nodes.bench_processes import processes
from tests.nodes.changes import shared_numbers
from tests.nodes.forked import Forked
from tests.nodes.own_domain import own_domain

OVERRIDES = ["run.t_end=0.4"]


class CountedSimulation(Simulation):
    """The simulator, which also counts what it sends: no message is on its way unnoticed."""

    def __init__(self, client, nodes, sent):
        super().__init__(client)
        self.nodes, self._sent, self._former = nodes, sent, 0

    @property
    def n_sent(self):
        return self._sent[0] - self._former

    def settle(self):
        """Wait until all that was sent has come; return how many states that are."""
        wait_until(lambda: len(self.states) == self.n_sent)
        return len(self.states)

    def await_end(self):
        """Wait until the run is over and has come; return how many states that are."""
        wait_until(lambda: self.state is State.STOPPED)
        return self.settle()

    def clear(self):
        self.settle()
        self.states.clear()
        self._former = self._sent[0]


@pytest.fixture(scope="module")
def simulation(tmp_path_factory):
    """Simulator, stopped, and launcher; they serve all tests here."""
    path = tmp_path_factory.mktemp("simulation") / "sent"
    sent = shared_numbers(path)
    with own_domain(), processes(Forked) as start, Client() as client:
        nodes = {
            "simulator": start(
                "simulator",
                f"changes.count_sent({str(path)!r}, {BENCH_STATE.name!r})",
                wait_for="[launcher]",
                initial_state="stopped",
                overrides=str(OVERRIDES),
                exit_when_done="false",
            ),
            "launcher": start("launcher"),
        }
        simulation = CountedSimulation(client, nodes, sent)
        client.await_answers_of("/simulator")  # it knows the subscriptions
        yield simulation


@pytest.fixture
def stopped(simulation):
    simulation.set(State.STOPPED)
    simulation.client.set("simulator", rtf=0.0)
    simulation.client.set("launcher", auto_release=True)
    simulation.await_end()
    simulation.clear()
    return simulation


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
    assert stopped.n_sent == 0
    assert stopped.set(State.PLAYING) == (Code.OK, "")
    assert stopped.await_end() == 401
    assert same(stopped.states, whole())


def test_pause_holds_and_play_goes_on_without_a_gap(stopped):
    stopped.client.set("simulator", rtf=0.1)
    stopped.set(State.PLAYING)
    wait_until(lambda: len(stopped.states) > 50)
    assert stopped.set(State.PAUSED) == (Code.OK, "")
    held = stopped.settle()
    assert held < 401
    time.sleep(0.2)
    assert stopped.n_sent == held
    stopped.client.set("simulator", rtf=1.0)
    began = time.monotonic()
    stopped.set(State.PLAYING)
    assert stopped.await_end() == 401
    # the pause is not caught up with: what was left takes its time
    assert time.monotonic() - began > 0.9 * (401 - held) * 1e-3
    assert same(stopped.states, whole())


@pytest.mark.parametrize("is_released", [True, False])
def test_pause_before_the_run_holds_it_at_its_start(is_released, stopped):
    stopped.client.set("launcher", auto_release=is_released)
    n_runs = len(stopped.runs)
    assert stopped.set(State.PAUSED)[0] == Code.OK
    wait_until(lambda: len(stopped.runs) > n_runs)
    time.sleep(0.2)
    assert stopped.n_sent == 0
    assert stopped.set(State.PLAYING) == (Code.OK, "")
    if not is_released:
        time.sleep(0.2)
        assert stopped.n_sent == 0
        assert stopped.client.set("launcher", auto_release=True)[0]
    assert stopped.await_end() == 401


def test_resets_begin_again_at_once_with_the_same_bits(stopped):
    """Messages are made before they are due; those of a sample that never comes do not count."""
    stopped.client.set("simulator", rtf=0.05)
    launcher = stopped.nodes["launcher"]
    mark = len(launcher.lines)
    stopped.set(State.PLAYING)
    n_seen = 0  # not cleared: all that is sent is counted, also where this test fails
    for scope in (0, 3, 7, 255):
        wait_until(lambda seen=n_seen: len(stopped.states) > seen + 20)
        run, since = stopped.runs[-1].run_id, len(launcher.lines)
        assert stopped.reset(scope) == (Code.OK, "")
        assert stopped.state is State.PLAYING
        wait_until(lambda run=run: stopped.runs[-1].run_id != run)
        n_seen = len(stopped.states)
        launcher.wait_for("ended early: reset", since=since)
    stopped.client.set("simulator", rtf=0.0)
    assert stopped.await_end() > n_seen
    assert same(stopped.states[-401:], whole())
    assert "missing" not in "".join(launcher.lines[mark:])


# parameters


def test_experiment_is_changed_while_stopped(stopped):
    wanted = ["run.t_end=0.1", "cone.R_c=0.02"]
    assert stopped.client.set("simulator", scenes=["tilt_p10"], overrides=wanted) == (True, "")
    try:
        stopped.set(State.PLAYING)
        assert stopped.await_end() == 101
        assert stopped.runs[-1].name == "tilt_p10"
        assert same(stopped.states, simulate(load_scene("tilt_p10", wanted)).samples)
    finally:
        assert stopped.client.set("simulator", scenes=["tilt_0"], overrides=OVERRIDES)[0]


def test_scene_over_the_network_is_a_name_or_text(stopped, tmp_path):
    """S11: no file of the simulator's machine is read for a client, not even a scene."""
    text = load_scene("tilt_p10", OVERRIDES).to_yaml()
    scene = tmp_path / "own.yaml"
    scene.write_text(text)
    beside = os.path.relpath(scene, config_dir() / "scenes")
    for path in ("/etc/passwd", str(scene), str(scene.with_suffix("")), beside):
        worked, reason = stopped.client.set("simulator", scenes=[path])
        assert not worked, path
        assert "must be a packaged scene's name, or YAML text" in reason
        assert "root:" not in reason
    assert not stopped.client.set("simulator", scenes=["no scene:\n  at: all"])[0]
    assert stopped.client.set("simulator", scenes=[text]) == (True, "")
    assert stopped.client.set("simulator", scenes=["tilt_0"]) == (True, "")


# what else is published


def test_diagnostics_say_how_it_goes(stopped):
    found = []
    stopped.client.subscribe("diagnostic_msgs/msg/DiagnosticArray", "diagnostics", found.append)
    stopped.client.set("simulator", rtf=1.0)
    stopped.set(State.PLAYING)
    stopped.await_end()

    def figures():
        for message in list(found):
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
    stopped.set(State.PLAYING)
    stopped.await_end()
    found = []
    stopped.client.subscribe(
        "std_msgs/msg/String", "robot_description", found.append, TRANSIENT_LOCAL
    )
    wait_until(lambda: found)
    links = {link.get("name") for link in ET.fromstring(found[-1].data).iter("link")}
    assert {"chaser/base_link", "target/cone", "chaser/tip"} <= links


def test_quitting_ends_the_simulator(start, client):
    node = start("simulator", initial_state="stopped", exit_when_done="false", __ns="/alone")
    simulation = Simulation(client, "/alone/simulator")
    assert simulation.state is State.STOPPED
    services = dict(client.node.get_service_names_and_types())
    assert not [name for name in services if "step" in name or "features" in name]
    assert simulation.set(State.QUITTING) == (Code.OK, "")
    assert node.status() == 0
