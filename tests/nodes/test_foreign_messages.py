"""Whatever a foreign publisher sends, a node goes on: odd messages are refused in a line each.

The messages are drawn from their definitions, with a fixed seed; ``CAPTURE_SIM_CASES=5000``
sends that many.  All nodes are started once and see all of them, within runs and between.
"""

import re

import pytest
import rclpy
from cases import cases
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from ports import free_port
from rclpy.duration import Duration
from rclpy.serialization import serialize_message

from capture_sim import load_scene
from capture_sim.hardware.messages import CONTACT_RIG, LOOP_SIMULATOR, TIP, TIP_WRENCH
from capture_sim.messages.topics import CLOCK, RUN_INFO, STREAM_COUNTS, TOPICS, RunSource
from capture_sim.nodes.base.endpoints import message_class, qos_of
from capture_sim.nodes.simulation.control import Code, State
from capture_sim.recording.bag import read_bag
from tests.nodes.bench_client import Client, Simulation, wait_until
from tests.nodes.bench_processes import processes
from tests.nodes.forked import Forked
from tests.nodes.own_domain import own_domain

EXAMPLES = cases(few=120, all=300)
READY = ("launcher", "capture_detector", "recorder", "viewer", CONTACT_RIG)
SCENES = [load_scene(name).to_yaml() for name in ("tilt_0", "paper_undamped")]
RUNS = ("", "run_1", "run_2", "../x", "\x1b[2J\n", "x" * 5000)
# of each node's lines, beside those of the messages themselves
FEW = 60
NUMBERS = (0.0, -0.0, 1.0, -1.0, 0.5, 5e-324, 1e308, float("nan"), float("inf"), -float("inf"))
TEXTS = (
    *("", "x", "simulator", "launcher", "capture_detector", "recorder", "bench/state"),
    *("world", "target/cone", "a\nb", "\x1b[31m", "../../x", "/etc/x", ".", "é" * 300, "y" * 20000),
    *("buffer_slide", "buffer_hinge", RUN_INFO.name, "/" + CLOCK.name),
)
NAMES = (*TEXTS, "tilt_0", "tilt_0 again")
SCENE_TEXTS = (
    *("", "a: [", "name: x", "&a [*a, *a]", "{[1]: 2}", "run: {rate: .nan}", "- 1", "!!int x"),
    *("x: " + "[" * 5000, "name: " + "z" * 100_000, SCENES[0].replace("0.2", ".nan", 1)),
)
INTEGERS = {"uint8": (0, 255), "int8": (-128, 127), "int32": (-(2**31), 2**31 - 1)}
INTEGERS |= {"uint32": (0, 2**32 - 1), "uint64": (0, 2**64 - 1), "uint16": (0, 65535)}


def values(kind, field=""):
    """Return what may stand in a field of a type, as ROS writes the type."""
    if fixed := re.fullmatch(r"(.+)\[(\d+)\]", kind):
        return st.lists(values(fixed[1]), min_size=int(fixed[2]), max_size=int(fixed[2]))
    if kind.startswith("sequence<"):
        inner = values(kind[9:-1].split(",")[0])
        return st.lists(inner, max_size=5) | inner.map(lambda value: [value] * 3000)
    if kind == "boolean":
        return st.booleans()
    if kind in ("double", "float"):
        return st.sampled_from(NUMBERS)
    if kind == "string":
        texts = {"run_id": RUNS, "name": NAMES, "scene": SCENE_TEXTS}
        return st.sampled_from(texts.get(field, TEXTS))
    if kind in INTEGERS:
        low, high = INTEGERS[kind]
        return st.sampled_from((low, high, 1, 2)) | st.integers(0, min(high, 5))
    package, name = kind.split("/")
    return messages(message_class(f"{package}/msg/{name}"))


def messages(kind):
    fields = kind.get_fields_and_field_types()
    return st.fixed_dictionaries(
        {name: values(type_name, name) for name, type_name in fields.items()}
    ).map(lambda found: kind(**found))


def valid_run():
    """Return runs that are taken up, so that what follows comes within one."""
    return st.builds(
        message_class(RUN_INFO.type_name),
        run_id=st.sampled_from(RUNS[1:3]),
        name=st.sampled_from(("foreign_1", "foreign_2")),
        scene=st.sampled_from(SCENES),
        state_rate=st.just(1000.0),
        rate=st.just(100.0),
        source=st.sampled_from(list(RunSource)),
        publishers=st.sampled_from(([], ["simulator"], ["launcher", "x"])),
    )


def sent():
    """Return topics with messages: drawn from the definition, or bytes that are none."""
    drawn = [
        st.tuples(st.just(topic), messages(message_class(topic.type_name)))
        for topic in (*(topic for topic in TOPICS if topic is not CLOCK), TIP)
    ]
    drawn.append(messages(message_class(TIP_WRENCH.type_name)).map(not_finite))
    drawn += [st.tuples(st.just(RUN_INFO), valid_run())] * 8
    drawn += [st.tuples(st.just(STREAM_COUNTS), messages(message_class(STREAM_COUNTS.type_name)))]
    whole = st.one_of(drawn)
    cut = st.tuples(whole, st.integers(0, 60)).map(
        lambda pair: (pair[0][0], serialize_message(pair[0][1])[: pair[1]])
    )
    return whole | whole | whole | whole | cut


def not_finite(wrench):
    """Return a wrench that the loop must not begin with."""
    wrench.wrench.force.x = float("nan")
    return TIP_WRENCH, wrench


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """All nodes that read runs, the simulation stopped, and a client."""
    out = tmp_path_factory.mktemp("foreign") / "out"
    with own_domain(), processes(Forked) as start, Client() as client:
        nodes = {
            # short runs: nobody is outrun, not this process either
            "simulator": start(
                "simulator",
                initial_state="stopped",
                rtf=0.0,
                overrides="[run.t_end=1.0]",
                exit_when_done="false",
            ),
            "launcher": start("launcher"),
            "capture_detector": start("capture_detector"),
            "recorder": start("recorder", out=out),
            "viewer": start("viewer", port=free_port()),
            CONTACT_RIG: start(CONTACT_RIG),
            LOOP_SIMULATOR: start(LOOP_SIMULATOR, start_timeout=3600.0, __ns="/loop"),
        }
        for name in READY:
            nodes[name].wait_for("ready")
        nodes[LOOP_SIMULATOR].wait_for("waiting")
        yield nodes, client, out


@pytest.fixture
def foreign(bench):
    """A node that publishes and that no executor spins.

    An executor that waits for the events of a publisher fails when that is destroyed meanwhile.
    """
    _, client, _ = bench
    node = rclpy.create_node("foreign", context=client.context)
    yield node
    node.destroy_node()


def test_three_thousand_refusals_are_few_lines(bench, foreign):
    nodes, client, _ = bench
    kind = message_class(RUN_INFO.type_name)
    publisher = foreign.create_publisher(kind, RUN_INFO.name, qos_of(RUN_INFO))
    wait_until(lambda: publisher.get_subscription_count() >= 4)
    began = {name: len(nodes[name].lines) for name in READY[:-1]}
    for number in range(3000):
        publisher.publish(kind(run_id=f"{number}", name="x", scene="a: ["))
    assert publisher.wait_for_all_acked(Duration(seconds=60))
    for name, since in began.items():
        client.await_answers_of(f"/{name}")
        nodes[name].wait_for("bench/run_info: rejected: ", since=since)
        # a busy machine's nodes also log which others are silent for a while
        lines = [line for line in nodes[name].lines[since:] if "heard" not in line]
        assert len(lines) < 3, name


def test_odd_messages_end_no_node(bench, foreign):
    nodes, client, out = bench
    simulation = Simulation(client)
    assert simulation.state is State.STOPPED
    publishers, count = {}, 0

    def publish(topic, message):
        if topic not in publishers:
            publishers[topic] = foreign.create_publisher(
                message_class(topic.type_name),
                f"loop/{topic.name}" if topic is TIP_WRENCH else topic.name,
                qos_of(topic, transient_local=topic.transient_local),
            )
        publishers[topic].publish(message)

    @settings(
        max_examples=EXAMPLES,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(sent())
    def send(drawn):
        nonlocal count
        publish(*drawn)
        count += 1
        if count % 20 == 0:
            ended = {n: node.text[-2000:] for n, node in nodes.items() if not node.is_alive}
            assert not ended

    kind = message_class(RUN_INFO.type_name)
    rates = {"state_rate": 1000.0, "rate": 100.0}
    run = {"run_id": "run_0", "name": "foreign_0", "source": "trial", "scene": SCENES[0]}
    publish(RUN_INFO, kind(**run, **rates))  # what follows comes within a run
    nodes["recorder"].wait_for("foreign_0: recording in")
    send()
    for name, node in nodes.items():
        full = f"/loop/{name}" if name == LOOP_SIMULATOR else f"/{name}"
        client.await_answers_of(full)
        assert node.is_alive, node.text
        assert len(node.lines) < FEW + EXAMPLES / 4, (name, len(node.lines))
        assert all(line.rstrip("\n").isprintable() for line in node.lines), name
        assert max(map(len, node.lines), default=0) < 1200
    assert set(out.parent.iterdir()) == {out}, nodes["recorder"].text
    # and they do what they are there for, once the foreign publishers have gone
    for publisher in publishers.values():
        foreign.destroy_publisher(publisher)

    def has_gone():
        ends = client.node.get_publishers_info_by_topic(f"/{RUN_INFO.name}")
        return "foreign" not in {end.node_name for end in ends}

    def is_free():  # of the last foreign run, whose announcer may be there for JOIN_TIMEOUT
        text = nodes["recorder"].text
        return text.count(": recording in ") == len(
            re.findall(r" messages, (?:in)?complete", text, re.I)
        )

    wait_until(has_gone)
    wait_until(is_free)
    for _ in range(2):  # the first takes in what came before it
        wait_until(lambda: simulation.state is State.STOPPED)
        assert simulation.set(State.PLAYING)[0] == Code.OK
        wait_until(lambda: simulation.state is State.STOPPED)
    pattern = r": (\S*/tilt_0\S*\.mcap): \d+ messages, complete"
    wait_until(lambda: re.search(pattern, nodes["recorder"].text), lambda: nodes["recorder"].text)
    run = read_bag(re.findall(pattern, nodes["recorder"].text)[-1])
    assert run.problems == ()
    assert run.statuses[-1].final
