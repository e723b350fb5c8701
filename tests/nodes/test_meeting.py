"""How nodes meet for a run, without DDS: who waits for whom, and who does not come."""

import math
from functools import partial

import pytest

from capture_sim import load_scene
from capture_sim.errors import CaptureSimError
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.topics import (
    BENCH_STATE,
    CHASER_POSE,
    ROLL,
    RUN_INFO,
    STREAM_COUNTS,
    RunSource,
)
from capture_sim.nodes.base.endpoints import DISCOVERY_TIME, TRANSIT_TIME, message_class
from capture_sim.nodes.protocol import announcer, follower, roll
from capture_sim.nodes.protocol.announcer import ALONE_TIME, STARTING_TIME, Announcer
from capture_sim.nodes.protocol.follower import JOIN_TIMEOUT, Follower
from capture_sim.nodes.protocol.roll import (
    DONE,
    FREE,
    FREE_TIMEOUT,
    HEARING_TIMEOUT,
    READY,
    Roll,
    run_key,
)
from tests.nodes.fake_node import FakeNode

OTHER = "/launcher#1"
GONE = "tilt_0: the simulator has gone without ending the run"
#: The simulator's counts of a run without messages.
ALL_SENT = ("simulator", "a run", {})


@pytest.fixture
def node(monkeypatch):
    node = FakeNode()
    for module in (announcer, follower, roll):
        monkeypatch.setattr(module, "time", node.clock())
    monkeypatch.setattr(roll, "POLL", -1.0)  # looked up every time
    return node


class Part:
    """What a node does with a run: it notes when it begins."""

    def __init__(self, node):
        self.node, self.begun, self.has_open_file = node, None, False

    def prepare(self, run):
        self.has_open_file = True

    def begin(self, run):
        self.begun = self.node.now

    def is_complete(self):
        return True

    def end(self, run, end):
        self.has_open_file = False
        return end.report

    cancel = end


def part_of(state, run="", participant=OTHER, heard=()):
    return message_class(ROLL.type_name)(
        participant=participant,
        role=participant[1:].partition("#")[0],
        sources=["simulation"],
        state=state,
        run=run,
        heard=heard,
    )


def reports(node):
    return [(t, message.state) for t, topic, message in node.sent if topic is ROLL]


# who takes part


@pytest.fixture
def following(node):
    """A follower to which a run is announced at 1 s, for itself and another node."""
    part = Part(node)
    following = Follower(node, "recorder", part, [RunSource.SIMULATION])
    following.follow(BENCH_STATE, lambda message: None)
    following.join()
    following.part = part
    run = RunDescription.of(
        load_scene("tilt_0"),
        "a run",
        (),
        announcer="/simulator#1",
        participants=sorted((following.roll.id, OTHER)),
    )
    following.key = run_key(run)
    node.publishers += ["/simulator", "/launcher"]
    node.at(1.0, lambda: node.hear(RUN_INFO, node.messages.run_info(run)))
    return following


def test_the_roll_is_the_last_that_a_node_reads(node, following):
    """Whoever is heard there is matched with all its other topics."""
    assert node.listened[-2:] == [RUN_INFO, ROLL]
    assert node.topic_publishers.topics[-1] is ROLL


def test_a_node_is_ready_once_it_has_heard_all_and_begins_once_all_are_ready(node, following):
    node.at(4.0, lambda: node.hear(ROLL, part_of(FREE)))
    node.at(7.0, lambda: node.hear(ROLL, part_of(READY, following.key)))
    node.at(20.0, node.end_request.set)
    with pytest.raises(KeyboardInterrupt):
        following.work()
    reported = reports(node)  # each part once a second
    assert reported[0][1] == FREE
    ready = next(t for t, state in reported if state == READY)
    assert ready == pytest.approx(4.0, abs=0.1)
    assert following.part.begun == pytest.approx(7.0, abs=0.1)
    assert not [line for line in node.log.lines if "has not joined" in line]


def test_a_trial_does_not_begin_by_what_drivers_send_in_any_case(node):
    """The recorder, which is slow, would miss the detector's criteria; of a simulator it begins.

    But what they send is taken once this node is ready: the launcher may then let go.
    """
    part = Part(node)
    following = Follower(node, "capture_detector", part, list(RunSource))
    heard = []
    following.follow(CHASER_POSE, heard.append)
    following.join()
    run = RunDescription.of(
        load_scene("tilt_0"),
        "a trial",
        (),
        source=RunSource.TRIAL,
        announcer="/launcher#1",
        participants=sorted((following.roll.id, OTHER, "/viewer#1")),
    )
    node.publishers += ["/launcher", "/viewer"]
    node.at(1.0, lambda: node.hear(RUN_INFO, node.messages.run_info(run)))
    for t in (1.2, 2.0, 3.0, 8.0):
        node.at(t, lambda t=t: node.hear(CHASER_POSE, t))
    for who in (OTHER, "/viewer#1"):
        node.at(1.5, lambda who=who: node.hear(ROLL, part_of(FREE, participant=who)))
    ready = partial(part_of, READY, run_key(run))
    node.at(2.5, lambda: node.hear(ROLL, ready(OTHER)))
    node.at(7.0, lambda: node.hear(ROLL, ready("/viewer#1")))
    node.at(12.0, node.end_request.set)
    with pytest.raises(KeyboardInterrupt):
        following.work()
    assert part.begun == pytest.approx(7.0, abs=0.1)
    assert heard == [2.0, 3.0, 8.0]


def test_a_node_that_replaces_a_killed_one_does_not_wait_for_it(node):
    """DDS reports the killed one for 12 s, and the launcher does not wait for it any longer."""
    part = Part(node)
    following = Follower(node, "capture_detector", part, list(RunSource))
    following.follow(CHASER_POSE, lambda message: None)
    following.join()
    own = following.roll.id
    killed = own.partition("#")[0] + "#0"
    run = RunDescription.of(
        load_scene("tilt_0"),
        "a trial",
        (),
        source=RunSource.TRIAL,
        announcer=OTHER,
        participants=sorted((killed, own, OTHER, "/viewer#1")),
    )
    node.publishers += ["/launcher", "/viewer"]
    node.at(1.0, lambda: node.hear(RUN_INFO, node.messages.run_info(run)))
    for who in (OTHER, "/viewer#1"):
        node.at(1.5, lambda who=who: node.hear(ROLL, part_of(FREE, participant=who)))
    node.at(4.0, following.begin)  # the launcher has let go, whatever the recorder has said
    node.at(12.0, node.end_request.set)
    with pytest.raises(KeyboardInterrupt):
        following.work()
    assert next(t for t, state in reports(node) if state == READY) == pytest.approx(1.5, abs=0.1)
    assert part.begun == pytest.approx(4.0, abs=0.1)


def test_who_does_not_join_is_named_and_the_run_begins(node, following):
    """Its writer is matched, and nothing of it comes: half a match."""
    node.at(60.0, node.end_request.set)
    with pytest.raises(KeyboardInterrupt):
        following.work()
    assert "tilt_0: /launcher has not joined the run" in node.log.lines
    assert following.part.begun == pytest.approx(1.0 + 2.0 * JOIN_TIMEOUT, abs=0.3)


def test_who_has_left_is_not_waited_for(node, following):
    node.at(2.0, lambda: node.hear(ROLL, part_of(FREE)))
    node.at(3.0, lambda: node.publishers.remove("/launcher"))
    node.at(20.0, node.end_request.set)
    with pytest.raises(KeyboardInterrupt):
        following.work()
    assert following.part.begun == pytest.approx(3.0, abs=0.1)


def test_ctrl_c_before_a_run_has_begun_closes_its_file(node, following):
    """A recording ended without its first message, the description of the run."""
    node.at(2.0, node.end_request.set)
    with pytest.raises(KeyboardInterrupt):
        following.work()
    assert following.part.begun is None
    assert not following.part.has_open_file
    assert "tilt_0: ended early: interrupted" in node.log.lines


@pytest.mark.parametrize("reason, status", [("", 1), ("stopped", 0)])
def test_messages_that_are_missing_at_ctrl_c_are_named_if_the_run_was_complete(
    node, following, reason, status
):
    """Nobody waits for a recorder that came late: it waited for what it had missed until Ctrl-C."""
    counts = message_class(STREAM_COUNTS.type_name)(
        run_id="a run", publisher="simulator", topics=[BENCH_STATE.name], counts=[3]
    )
    counts.complete, counts.reason = not reason, reason
    node.at(2.0, lambda: node.hear(ROLL, part_of(READY, following.key)))
    node.at(3.0, lambda: node.hear(STREAM_COUNTS, counts))
    node.at(4.0, node.end_request.set)
    with pytest.raises(KeyboardInterrupt):
        following.work()
    assert node.exit_status == status
    missing = "tilt_0: ended with messages missing: bench/state: 3 messages missing (seq 0 to 2)"
    assert (missing in node.log.lines) == bool(status)
    assert ("tilt_0: ended early: interrupted" in node.log.lines) != bool(status)


@pytest.fixture
def watching(node):
    """A follower without streams, as a viewer has, of a run that is announced at 1 s."""

    class Watching(Part):
        def end(self, run, end):
            self.ended = self.node.now
            return end.report

    watching = Follower(node, "viewer", Watching(node), [RunSource.SIMULATION], on_roll=False)
    watching.join()
    watching.part = watching._part
    run = RunDescription.of(
        load_scene("tilt_0"), "a run", ["simulator"], announcer="/simulator#1", participants=()
    )
    node.at(1.0, lambda: node.hear(RUN_INFO, node.messages.run_info(run)))
    node.at(60.0, node.end_request.set)
    return watching


@pytest.mark.parametrize("named, ended", [(4.0, 30.0), (math.inf, 1.0 + JOIN_TIMEOUT)])
def test_an_announcer_whose_name_is_not_known_yet_has_not_gone(node, watching, named, ended):
    """On a busy machine names are known seconds later than the first message comes."""
    node.at(named, lambda: node.publishers.append("/simulator"))
    node.at(30.0, lambda: node.hear(STREAM_COUNTS, node.messages.stream_counts(*ALL_SENT)))
    with pytest.raises(KeyboardInterrupt):
        watching.work()
    assert watching.part.ended == pytest.approx(ended, abs=TRANSIT_TIME + 0.2)
    assert (GONE in node.log.lines) == math.isinf(named)


@pytest.mark.parametrize("is_sent", [True, False])
def test_a_starved_node_reads_waiting_messages_before_it_ends_the_run(node, watching, is_sent):
    """The simulator has exited meanwhile, and its counts, which end the run, are not read yet."""
    node.publishers.append("/simulator")

    def be_starved():
        node.publishers.remove("/simulator")
        node.now += 5.0

    node.at(3.0, be_starved)
    if is_sent:
        node.at(8.05, lambda: node.hear(STREAM_COUNTS, node.messages.stream_counts(*ALL_SENT)))
    with pytest.raises(KeyboardInterrupt):
        watching.work()
    assert watching.part.ended == pytest.approx(8.0 if is_sent else 8.0 + TRANSIT_TIME, abs=0.2)
    assert (GONE in node.log.lines) != is_sent


# who announces


@pytest.fixture
def announcing(node):
    node.name = "/simulator"
    node.publishers = ["/simulator"]
    node.open([BENCH_STATE])
    return Announcer(node, Roll(node, "simulator"), RunSource.SIMULATION, ["launcher"])


def announce(node, announcing):
    run = RunDescription.of(
        load_scene("tilt_0"), "a run", (), announcer="/simulator#1", participants=[OTHER]
    )
    announcing.announce(run, node.messages.serialise(node.messages.run_info(run)))
    return run


def test_a_run_is_refused_to_whom_it_waits_for_and_does_not_join(node, announcing):
    node.publishers.append("/launcher")
    node.hear(ROLL, part_of(FREE))
    with pytest.raises(CaptureSimError, match="launcher has not joined the run"):
        announce(node, announcing)
    assert node.now == pytest.approx(node.topic_publishers.reader_timeout, abs=0.1)
    assert any("waiting for /launcher to join the run" in line for line in node.log.lines)


def test_a_run_begins_once_all_have_joined(node, announcing):
    node.publishers.append("/launcher")
    node.hear(ROLL, part_of(FREE))
    node.at(3.0, lambda: node.hear(ROLL, part_of(READY, "a run@/simulator#1")))
    announce(node, announcing)
    assert node.now == pytest.approx(3.0, abs=0.1)


def test_a_plain_node_is_there_when_all_it_reads_is_matched(node, announcing):
    """By its name in the graph alone, its first messages were lost."""
    node.topic_publishers.found[BENCH_STATE] = ["/lab/launcher", "/other"]
    node.topic_publishers.n_matched[BENCH_STATE] = 1
    node.at(9.0, lambda: node.topic_publishers.n_matched.update({BENCH_STATE: 2}))
    announcing.await_nodes("tilt_0", 60.0)
    assert node.now == pytest.approx(9.0, abs=0.1)


def test_a_node_that_is_still_starting_is_no_plain_one(node, announcing):
    """On a busy machine a run began without its detector, which had yet to join the roll."""
    node.topic_publishers.found[BENCH_STATE] = ["/launcher"]
    node.topic_publishers.n_matched[BENCH_STATE] = 1

    def join():
        node.publishers.append("/launcher")
        node.hear(ROLL, part_of(FREE))

    node.at(0.8 * STARTING_TIME, join)
    announcing.await_nodes("tilt_0", 60.0)
    assert node.now == pytest.approx(0.8 * STARTING_TIME, abs=0.1)
    assert announcing.participants("tilt_0").roles == ("launcher",)


def test_subscriptions_that_have_just_come_may_not_be_all(node, announcing):
    node.topic_publishers.n_matched[BENCH_STATE] = 1
    node.at(5.0, lambda: node.topic_publishers.found[BENCH_STATE].append("/launcher"))
    announcing.await_nodes("tilt_0", 60.0)
    assert node.now >= 5.0 + DISCOVERY_TIME


def alone(node):
    node.name, node.publishers = "/simulator", ["/simulator"]
    return Announcer(node, Roll(node, "simulator"), RunSource.SIMULATION, [])


def test_a_node_that_hears_no_other_is_alone(node):
    alone(node).await_nodes("tilt_0", 60.0)
    assert node.now == pytest.approx(ALONE_TIME, abs=0.1)


@pytest.mark.parametrize(
    "knows, begins",
    [
        ([], DISCOVERY_TIME),
        (["/simulator#0"], DISCOVERY_TIME),  # this node, or one that it replaces
        (["/second#1"], 1.5),
        (["/killed#1"], DISCOVERY_TIME + HEARING_TIMEOUT),
    ],
)
def test_a_node_waits_for_the_nodes_that_another_one_has_heard(knows, begins, node):
    """It began with the first, before it knew that a second one filled the same role."""
    node.at(0.1, lambda: node.hear(ROLL, part_of(FREE, participant="/first#1", heard=knows)))
    node.at(1.5, lambda: node.hear(ROLL, part_of(FREE, participant="/second#1")))
    announcing = alone(node)
    announcing.await_nodes("tilt_0", 60.0)
    assert node.now == pytest.approx(begins, abs=0.05)
    announcing.participants("tilt_0")  # a killed node is not waited for again
    assert node.now == pytest.approx(begins, abs=0.05)


def test_a_node_tells_at_once_whom_it_has_heard_and_no_longer_once_that_has_left(node):
    node.publishers = ["/simulator", "/first"]
    Roll(node, "simulator")
    node.at(1.1, lambda: node.hear(ROLL, part_of(FREE, participant="/first#1")))
    node.at(2.5, lambda: node.publishers.remove("/first"))
    node.wait(limit=5.0)
    told = {round(t, 1): message.heard for t, topic, message in node.sent if topic is ROLL}
    assert told[1.0] == told[3.0] == []
    assert told[1.1] == told[2.0] == ["/first#1"]


@pytest.mark.parametrize("is_named", [True, False])
def test_no_run_beside_a_trial_that_is_discovered_late(node, is_named):
    """On a busy machine discovery took 0.6 s, and a name is known later than the first message."""

    def join():
        if is_named:
            node.publishers.append("/launcher")
        part = part_of(READY)
        part.source = str(RunSource.TRIAL)
        node.hear(ROLL, part)

    node.at(0.8 * ALONE_TIME, join)
    with pytest.raises(CaptureSimError, match="/launcher in a trial of a real bench"):
        alone(node).await_nodes("tilt_0", 60.0)


def test_a_run_after_a_node_was_killed_in_a_trial(node):
    """It can report no end of its trial."""
    announcing, part = alone(node), part_of(READY)
    part.source = str(RunSource.TRIAL)
    node.publishers.append("/launcher")
    node.hear(ROLL, part)
    node.at(20.0, lambda: node.publishers.remove("/launcher"))
    node.wait(limit=21.0)
    announcing.await_nodes("tilt_0", 60.0)


@pytest.mark.parametrize("ends, waited", [(2.0, 2.0), (60.0, FREE_TIMEOUT)])
def test_a_trial_waits_for_a_node_that_still_closes_its_file(node, ends, waited):
    node.name, node.publishers = "/launcher", ["/launcher", "/recorder"]
    taking_part, other = Roll(node, "launcher"), "/recorder#1"

    def be(state):
        node.hear(
            ROLL,
            message_class(ROLL.type_name)(
                participant=other, role="recorder", sources=["trial"], state=state, source="replay"
            ),
        )

    be(READY)
    node.at(ends, lambda: be(DONE))
    taking_part.await_free(RunSource.TRIAL, lambda: False)
    assert node.now == pytest.approx(waited, abs=0.1)
    is_busy = bool(taking_part.busy(RunSource.TRIAL))
    assert is_busy == (ends > waited)
    assert is_busy != bool(taking_part.free(RunSource.TRIAL))


def test_a_role_that_is_named_twice_is_waited_for_twice(node):
    """One of two recorders came after the announcement, and missed the first messages."""
    alone(node)
    announcing = Announcer(
        node, Roll(node, "simulator"), RunSource.SIMULATION, ["recorder", "recorder"]
    )

    def join(participant):
        node.publishers.append("/recorder")
        node.hear(ROLL, part_of(FREE, participant=participant))

    node.at(1.0, lambda: join("/recorder#1"))
    node.at(5.0, lambda: join("/recorder#2"))
    announcing.await_nodes("tilt_0", 60.0)
    assert node.now == pytest.approx(5.0, abs=0.1)
    assert announcing.participants("tilt_0").participants == ("/recorder#1", "/recorder#2")


def test_a_run_is_refused_if_one_of_two_recorders_does_not_join(node):
    alone(node)
    ids = ["/recorder#1", "/recorder#2"]
    roll = Roll(node, "simulator")
    announcing = Announcer(node, roll, RunSource.SIMULATION, ["recorder", "recorder"])
    node.publishers.append("/recorder")
    for participant in ids:
        node.hear(ROLL, part_of(FREE, participant=participant))
    run = RunDescription.of(
        load_scene("tilt_0"), "a run", (), announcer="/simulator#1", participants=ids
    )
    joined = part_of(READY, run_key(run), participant=ids[0])
    node.at(1.0, lambda: node.hear(ROLL, joined))
    with pytest.raises(CaptureSimError, match="recorder has not joined the run"):
        announcing.announce(run, node.messages.serialise(node.messages.run_info(run)))


def test_who_does_not_come_is_named(node, announcing):
    with pytest.raises(CaptureSimError, match="waiting for launcher to start: timed out after 9 s"):
        announcing.await_nodes("tilt_0", 9.0)


# one node a role


@pytest.mark.parametrize(
    "wanted, silent_from, refused",
    [
        ([], math.inf, "/recorder and /second are recorder both: a run takes 1"),
        (["recorder", "recorder"], math.inf, ""),
        (["/recorder", "second"], math.inf, ""),
        ([], 1.5, ""),  # killed, and still discovered
    ],
)
def test_a_second_node_of_a_role_refuses_the_run_unless_two_are_wanted(
    node, wanted, silent_from, refused
):
    alone(node)
    announcing = Announcer(node, Roll(node, "simulator"), RunSource.SIMULATION, wanted)
    node.publishers += ["/recorder", "/second"]

    def sign(participant, silent_from=math.inf):
        part = part_of(FREE, participant=participant)
        part.role = "recorder"
        for t in range(1, 60):
            if t <= silent_from:
                node.at(float(t), lambda: node.hear(ROLL, part))

    sign("/recorder#1", silent_from)
    sign("/second#2")
    announcing.await_nodes("tilt_0", 60.0)
    if refused:
        with pytest.raises(CaptureSimError, match=refused):
            announcing.participants("tilt_0")
    else:
        found = announcing.participants("tilt_0").participants
        assert set(found) == {"/recorder#1", "/second#2"}  # DDS still knows a killed one


def test_two_nodes_of_a_role_name_each_other(node, following):
    part = part_of(FREE, participant="/second#1")
    part.role = "recorder"
    node.hear(ROLL, part)
    node.hear(ROLL, part)
    assert [line.split(":")[0] for line in node.log.lines] == [
        "/second is a recorder, as this node is"
    ]


@pytest.mark.parametrize("announcer_is_on_roll", [True, False])
def test_nobody_joins_a_run_that_was_announced_without_him(node, announcer_is_on_roll):
    """`ros2 bag play` is not on the roll: whoever is there evaluates what it plays."""
    part = Part(node)
    following = Follower(node, "recorder", part, [RunSource.SIMULATION])
    following.join()
    node.publishers += ["/simulator"]
    if announcer_is_on_roll:
        node.hear(ROLL, part_of(FREE, participant="/simulator#1"))
    run = RunDescription.of(
        load_scene("tilt_0"), "a run", (), announcer="/simulator#1", participants=[OTHER]
    )
    node.at(1.0, lambda: node.hear(RUN_INFO, node.messages.run_info(run)))
    node.at(40.0, node.end_request.set)
    with pytest.raises(KeyboardInterrupt):
        following.work()
    assert (part.begun is None) == announcer_is_on_roll
    assert any("before this node had come" in line for line in node.log.lines) == (
        announcer_is_on_roll
    )
