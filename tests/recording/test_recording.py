"""Recordings: what is written comes back, by our own and by others' readers."""

from __future__ import annotations

import hashlib
import json
import os
import re
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from bags import copied, in_two_files
from full_disk import file_size_limit
from mcap.reader import make_reader
from mcap.records import Channel, DataEnd, Message
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from recorded import n_sent
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

import capture_sim
from capture_sim.base.files import free_path
from capture_sim.dynamics.samples import SAMPLE, TOUCH
from capture_sim.errors import RecordingError
from capture_sim.messages.cdr import columns, sequence_of, stamp_of
from capture_sim.messages.convert import Messages, RunDescription
from capture_sim.messages.definitions import (
    schema_text,
    typestore,
)
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    CAPTURE_STATUS,
    CAPTURE_VERDICT,
    CLOCK,
    JOINT_STATES,
    LAUNCHER_PHASE,
    RUN_INFO,
    SHOWN,
    STREAM_COUNTS,
    TOPICS,
)
from capture_sim.recording import live as live_module
from capture_sim.recording.bag import read_bag
from capture_sim.recording.completeness import Completeness
from capture_sim.recording.live import LiveRecorder
from capture_sim.recording.offline import PUBLISHERS, run_stream, write_run
from capture_sim.recording.write import RunWriter
from capture_sim.scene.loading import load_scene_text

NAME = "tilt_m10"


@pytest.fixture(scope="module")
def result():
    everything = ["sensors.motion_capture={}", "sensors.load_cell={}", "run.trace=true"]
    return capture_sim.simulate(capture_sim.load_scene(NAME, everything))


@pytest.fixture(scope="module")
def run(result):
    return RunDescription.of(result.scene, "a run", PUBLISHERS)


@pytest.fixture(scope="module")
def path(result, tmp_path_factory):
    return write_run(result, tmp_path_factory.mktemp("runs") / f"{NAME}.mcap", run_id="a run")


@pytest.fixture(scope="module")
def sent(result, run):
    """All messages of the run, serialised, in the order of the nodes."""
    return [(topic, data) for topic, _, data in run_stream(result, run)]


def bits(array):
    return np.ascontiguousarray(array).tobytes()


def test_file_holds_the_messages_of_the_nodes_in_their_order(path, sent):
    topics, found = {}, []
    with path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                found.append((topics[record.channel_id], record.data))
            elif isinstance(record, DataEnd):
                assert record.data_section_crc != 0  # of metadata too, which no chunk covers
    shown = {topic.absolute_name for topic in SHOWN}
    assert [each for each in found if each[0] not in shown] == [
        (topic.absolute_name, data) for topic, data in sent
    ]


def test_a_live_recording_is_not_overwritten(result, sent, tmp_path):
    live = record(tmp_path, sent[:50]).close().path
    before = live.read_bytes()
    assert record(tmp_path, sent[:50]).close().path == tmp_path / f"{NAME}_2.mcap"
    assert write_run(result, live) == tmp_path / f"{NAME}_3.mcap"
    assert live.read_bytes() == before
    # but a simulated run, which can be made again, is replaced
    assert write_run(result, tmp_path / f"{NAME}_3.mcap") == tmp_path / f"{NAME}_3.mcap"


# our own reader


def test_run_read_back_is_the_run(result, path):
    run = read_bag(path)
    assert run.complete
    assert run.problems == ()
    assert bits(run.samples) == bits(result.samples)
    recorded = [name for name in TOUCH.names if name != "rate_ratio"]  # no message carries it
    for name in recorded:
        assert bits(run.touches[name]) == bits(result.touches[name])
    assert np.isnan(run.touches["rate_ratio"]).all()
    assert list(run.statuses) == result.statuses
    assert run.verdict == result.verdict
    assert len(run.events) == len(result.events)
    for mine, theirs in zip(run.events, result.events, strict=True):
        assert (mine.kind, mine.t, mine.wall, mine.detail) == (
            theirs.kind,
            theirs.t,
            theirs.wall,
            theirs.detail,
        )
        assert bits(mine.q) == bits(theirs.q)
        assert bits(mine.v) == bits(theirs.v)
        assert (mine.touch is None) == (theirs.touch is None)
        if mine.touch is not None:
            assert mine.touch[recorded] == theirs.touch[recorded]
    assert run.wall_time == result.wall_time


def test_scene_inside_is_the_one_that_made_the_run(result, path):
    run = read_bag(path)
    assert run.scene == result.scene
    assert load_scene_text(run.scene_text) == result.scene
    assert run.metadata["scene_sha256"] == hashlib.sha256(run.scene_text.encode()).hexdigest()
    assert run.metadata["run_id"] == run.run_id == "a run"
    assert run.name == NAME


def test_columns_of_every_topic_agree_with_a_decoder_of_messages(path):
    run = read_bag(path)
    store = typestore()
    for topic in TOPICS:
        found = run.columns(topic.name)
        messages = [store.deserialize_cdr(data, topic.type_name) for data in run.raw(topic.name)]
        assert len(messages) == run.topics[topic.absolute_name] > 0
        paths = dict(leaves(messages[0]))
        assert set(found) == set(paths)
        some = slice(None, None, len(messages) // 50 + 1)
        for i in range(len(messages))[some]:
            for name, value in leaves(messages[i]):
                assert np.array_equal(found[name][i], value), (topic.name, name)
    assert run.columns("no/such/topic") == {}
    assert run.log_times("no/such/topic").size == 0


def leaves(message, prefix=""):
    """Yield the path and value of every plain field of a message."""
    for name, _ in typestore().fielddefs[message.__msgtype__][1]:
        value = getattr(message, name)
        if hasattr(value, "__msgtype__"):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


# others' readers


def test_mcap_ros2_decoder_sees_the_same_numbers(path, result):
    seen, kinds, every = 0, [], 0
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, raw, message in reader.iter_decoded_messages():
            every += 1
            if channel.topic == "/bench/event":
                kinds.append(message.kind)
            if channel.topic != "/bench/state":
                continue
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            assert raw.log_time == raw.publish_time == 10**9 + seen * 10**6
            assert message.seq == seen
            sample = result.samples[seen]
            for name in SAMPLE.names:
                value = np.array(getattr(message, name), SAMPLE[name].base)
                assert bits(value) == bits(sample[name])
            seen += 1
    assert seen == len(result.samples)
    assert kinds == [event.kind.label for event in result.events]
    assert every == sum(read_bag(path).topics.values())


def test_rosbags_knows_quality_of_service_and_types(path):
    with Reader(path) as reader:
        assert reader.message_count == sum(read_bag(path).topics.values())
        durable = {
            connection.topic
            for connection in reader.connections
            if connection.ext.offered_qos_profiles[0].durability is QosDurability.TRANSIENT_LOCAL
        }
        assert durable == {t.absolute_name for t in (*TOPICS, *SHOWN) if t.transient_local}
        for connection in reader.connections:
            qos = connection.ext.offered_qos_profiles[0]
            topic = next(t for t in (*TOPICS, *SHOWN) if t.absolute_name == connection.topic)
            assert (qos.depth, qos.reliability.name) == (topic.depth, "RELIABLE")


def test_type_hashes_are_those_of_ros(path):
    pytest.importorskip("rclpy", reason="needs ROS")
    with path.open("rb") as file:
        channels = list(make_reader(file).get_summary().channels.values())
        schemas = make_reader(file).get_summary().schemas
    for channel in channels:
        package, _, name = schemas[channel.schema_id].name.split("/")
        assert channel.metadata["topic_type_hash"] == installed_hash(package, name)


def installed_hash(package, name):
    """Return the type hash that rosidl has written beside the installed definition."""
    places = [sys.prefix, *os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)]
    for place in filter(None, places):
        for found in Path(place).rglob(f"share/{package}/msg/{name}.json"):
            hashes = json.loads(found.read_text())["type_hashes"]
            wanted = f"{package}/msg/{name}"
            return next(e["hash_string"] for e in hashes if e["type_name"] == wanted)
    raise AssertionError(f"no type hash of {package}/msg/{name} is installed")


def test_schema_tells_the_units():
    text = schema_text("capture_sim/msg/BenchState")
    assert re.search(r"^float64 string_tension +# N$", text, re.MULTILINE)
    assert "MSG: std_msgs/Header" in text
    assert "MSG: builtin_interfaces/Time" in text


def test_rosbag2_metadata_is_embedded_and_right(path):
    with path.open("rb") as file:
        reader = make_reader(file)
        records = {record.name: record.metadata for record in reader.iter_metadata()}
        statistics = reader.get_summary().statistics
    info = yaml.safe_load(records["rosbag2"]["serialized_metadata"])
    assert (info["version"], info["storage_identifier"]) == (9, "mcap")
    assert info["relative_file_paths"] == [path.name]
    assert info["message_count"] == statistics.message_count
    start = info["starting_time"]["nanoseconds_since_epoch"]
    assert start == statistics.message_start_time == 10**9
    assert start + info["duration"]["nanoseconds"] == statistics.message_end_time
    counts = {
        entry["topic_metadata"]["name"]: entry["message_count"]
        for entry in info["topics_with_message_count"]
    }
    assert counts == read_bag(path).topics
    assert all(
        entry["topic_metadata"]["type_description_hash"].startswith("RIHS01_")
        for entry in info["topics_with_message_count"]
    )


# order, and what is no recording


def test_messages_come_in_the_order_of_their_times_whatever_the_files(path, tmp_path):
    # as two recorders' parts put together, or a bag of a reliable but late network
    run = read_bag(path)
    times, data = run.log_times("bench/state").tolist(), run.raw("bench/state")
    with BagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        name, kind = BENCH_STATE.absolute_name, BENCH_STATE.type_name
        topic = writer.add_connection(name, kind, typestore=typestore())
        for i in np.random.default_rng(3).permutation(len(times)).tolist():
            writer.write(topic, times[i], data[i])
    mixed = read_bag(tmp_path / "bag")
    assert mixed.raw("bench/state") == data
    assert mixed.log_times("bench/state").tolist() == times


def test_not_a_recording_is_refused_in_one_line(tmp_path):
    text = tmp_path / "text.mcap"
    text.write_text("hello")
    for path in (text, tmp_path / "nowhere.mcap", tmp_path):
        with pytest.raises(RecordingError) as caught:
            read_bag(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)


# writing


def test_unwritable_folder_is_refused_in_one_line(run, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot write") as caught:
        RunWriter(tmp_path / "file" / "x.mcap", run)
    assert "\n" not in str(caught.value)
    with pytest.raises(RecordingError, match="cannot write"):
        RunWriter(tmp_path, run)  # a folder


def test_a_file_that_did_not_become_whole_has_no_name(result, tmp_path):
    path = tmp_path / "full.mcap"
    with file_size_limit(300_000), pytest.raises(RecordingError, match="cannot write") as caught:
        write_run(result, path)
    assert str(caught.value).startswith(f"{path}: ")  # not the name of a hidden part
    assert list(tmp_path.iterdir()) == []


def test_run_off_the_grid_is_not_recorded(tmp_path):
    scene = capture_sim.load_scene("paper_designed")
    result = capture_sim.simulate(scene, t_eval=np.linspace(0.0, 0.1, 37))
    with pytest.raises(RecordingError, match="state_rate"):
        write_run(result, tmp_path / "x.mcap")


def test_an_error_in_the_middle_leaves_a_whole_file(run, sent, tmp_path):
    path = tmp_path / "x.mcap"

    def write_some():
        with RunWriter(path, run) as writer:
            for topic, data in sent[:3000]:
                writer.write(topic, data, stamp_of(topic, data))
            raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        write_some()
    found = read_bag(path)
    assert not found.damage
    assert n_sent(found) == 3000


def test_writing_after_the_end_is_refused(run, tmp_path):
    writer = RunWriter(tmp_path / "x.mcap", run)
    writer.close()
    writer.close()
    with pytest.raises(RecordingError, match="already closed"):
        writer.write(RUN_INFO, b"", None)


# live


def record(folder, messages, **options):
    """Record messages, the first of which announces the run."""
    (topic, info), *others = messages
    assert topic is RUN_INFO
    recorder = LiveRecorder(folder, info, **options)
    for topic, data in others:
        recorder.take(topic, data)
    return recorder


def test_live_recording_holds_the_same_as_the_offline_one(path, sent, tmp_path):
    recorder = record(tmp_path, sent)
    assert recorder.done
    report = recorder.close()
    assert report.complete
    assert report.problems == ()
    assert report.path == tmp_path / f"{NAME}.mcap"
    live, offline = read_bag(report.path), read_bag(path)
    assert live.complete
    assert live.topics == offline.topics
    for name in offline.topics:
        assert live.raw(name) == offline.raw(name)
        assert live.log_times(name).tolist() == offline.log_times(name).tolist()
    assert live.scene_text == offline.scene_text
    assert live.wall_time > 0.0


@pytest.mark.parametrize("part", [0.0, 0.5, 1.0])
def test_a_dropped_message_of_each_topic_is_reported(part, sent, tmp_path):
    """The first, one in the middle, the last."""
    dropped = {}
    for topic in {topic for topic, _ in sent} - {RUN_INFO, STREAM_COUNTS}:
        places = [i for i, (of, _) in enumerate(sent) if of is topic]
        dropped[places[round(part * (len(places) - 1))]] = topic
    recorder = record(tmp_path, [m for i, m in enumerate(sent) if i not in dropped])
    assert not recorder.done
    report = recorder.close()
    assert not report.complete
    wanted = {
        f"{topic.name}: 1 messages missing"
        + (f" (seq {sequence_of(topic, sent[i][1])})" if topic.sequenced else "")
        for i, topic in dropped.items()
        if not topic.holds_state
    }
    if part == 1.0:  # an earlier state may be replaced on its way, which is no loss
        states = {topic for topic, _ in sent if topic.holds_state}
        assert states == {LAUNCHER_PHASE, CAPTURE_VERDICT}
        wanted |= {f"{topic.name}: last message missing" for topic in states}
    assert set(report.problems) == wanted
    # and it is seen again when the file is read
    assert set(read_bag(report.path).problems) == wanted


def test_repeated_and_disordered_messages_are_reported(sent, tmp_path):
    at = next(i for i, (topic, _) in enumerate(sent) if topic is BENCH_STATE)
    twice = record(tmp_path, [*sent[: at + 1], sent[at], *sent[at + 1 :]]).close()
    assert not twice.complete
    assert any("repeated or disordered" in line for line in twice.problems)


def test_publisher_that_never_ends_is_named(sent, tmp_path):
    recorder = record(tmp_path, [m for m in sent if m[0] is not STREAM_COUNTS])
    assert not recorder.done
    report = recorder.close()
    assert [line.split(":")[0] for line in report.problems] == list(PUBLISHERS)
    assert read_bag(report.path).problems == report.problems


def test_counts_of_another_run_are_ignored(sent, tmp_path):
    make = Messages()
    counts = make.stream_counts("simulator", "another", {"bench/state": 10**6})
    strange = (STREAM_COUNTS, make.serialise(counts))
    assert record(tmp_path, [sent[0], strange, *sent[1:]]).close().problems == ()


def test_run_that_ended_early_is_reported(sent, run, tmp_path):
    make = Messages()
    ended = make.stream_counts("simulator", run.run_id, {}, complete=False, reason="Ctrl-C")
    report = record(tmp_path, [sent[0], (STREAM_COUNTS, make.serialise(ended))]).close()
    assert "simulator ended the run early: Ctrl-C" in report.problems
    assert "simulator ended the run early: Ctrl-C" in read_bag(report.path).problems


def test_simulation_that_failed_is_recorded_as_far_as_it_came(tmp_path):
    scene = capture_sim.load_scene("tilt_0", ["run.max_steps=300"])
    with pytest.raises(capture_sim.SimulationError) as caught:
        capture_sim.simulate(scene)
    partial = caught.value.result
    run = read_bag(write_run(partial, tmp_path / "x.mcap"))
    assert len(run.samples) > 1000
    assert bits(run.samples) == bits(partial.samples)
    assert len(run.problems) == len(PUBLISHERS)
    assert all("max_steps" in line for line in run.problems)


def stalling_at(is_due, monkeypatch):
    """Let the disk stall where ``is_due(count, topic)``, until the returned event is set."""
    stalled, write, written = threading.Event(), RunWriter.write, []

    def write_or_stall(writer, topic, data, stamp):
        if is_due(len(written), topic):
            writer.flush()
            stalled.wait(30.0)
        write(writer, topic, data, stamp)
        written.append(topic)

    monkeypatch.setattr(RunWriter, "write", write_or_stall)
    return stalled


def test_stalled_disk_is_reported_once_and_keeps_what_it_has(sent, tmp_path, monkeypatch):
    """The first call waits, every later one fails at once with the same line."""
    monkeypatch.setattr(live_module, "STALL_LIMIT", 0.3)
    stalled = stalling_at(lambda count, _: count == 1000, monkeypatch)
    recorder = record(tmp_path, sent[:1], queue_bytes=300_000)
    with pytest.raises(RecordingError, match=r"nothing for 0.3 s: the recording ends") as first:
        for topic, data in sent[1:]:
            recorder.take(topic, data)
    monkeypatch.setattr(live_module, "STALL_LIMIT", 600.0)
    with pytest.raises(RecordingError) as later:
        recorder.take(*sent[1500])
    monkeypatch.setattr(live_module, "STALL_LIMIT", 0.3)
    with pytest.raises(RecordingError) as last:
        recorder.close()
    assert first.value is later.value is last.value
    assert n_sent(read_bag(tmp_path / f"{NAME}.mcap")) == 1000
    stalled.set()


def test_waiting_messages_without_content_are_bounded_too(sent, tmp_path, monkeypatch):
    monkeypatch.setattr(live_module, "STALL_LIMIT", 0.0)
    stalled = stalling_at(lambda *_: True, monkeypatch)
    recorder = record(tmp_path, sent[:1], queue_bytes=50_000)
    with pytest.raises(RecordingError, match="wrote nothing"):
        for _ in range(1000):
            recorder.take(CLOCK, bytes(12))  # encapsulation and a stamp
    stalled.set()


def test_small_queue_waits_and_loses_nothing(sent, tmp_path):
    assert record(tmp_path, sent, queue_bytes=200_000).close().complete


def test_unwritable_folder_stops_the_live_recorder(sent, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot write"):
        record(tmp_path / "file", sent[:1])


def test_disk_that_fills_stops_the_live_recorder(sent, tmp_path):
    with file_size_limit(300_000), pytest.raises(RecordingError, match="cannot write"):
        record(tmp_path, sent).close()
    assert len(read_bag(tmp_path / f"{NAME}.mcap").samples) > 0


def test_close_gives_up_a_disk_that_stalls(sent, tmp_path, monkeypatch):
    """It neither hangs nor loses what the disk has taken."""
    monkeypatch.setattr(live_module, "STALL_LIMIT", 1.5)  # s, longer than a busy machine pauses
    counts = sum(topic is STREAM_COUNTS for topic, _ in sent)
    stalled = stalling_at(lambda _, topic: topic is STREAM_COUNTS, monkeypatch)
    recorder = record(tmp_path, sent)
    with pytest.raises(RecordingError, match=r"wrote nothing for 1.5 s: the recording ends there"):
        recorder.close()
    copy = tmp_path / "copy.mcap"
    copy.write_bytes((tmp_path / f"{NAME}.mcap").read_bytes())
    stalled.set()
    assert n_sent(read_bag(copy)) == len(sent) - counts


def test_a_slow_disk_is_waited_for_as_long_as_it_writes(sent, tmp_path, monkeypatch):
    monkeypatch.setattr(live_module, "STALL_LIMIT", 1.5)  # s, longer than a busy machine pauses
    write = RunWriter.write

    def write_slowly(writer, *message):
        time.sleep(0.02)
        write(writer, *message)

    monkeypatch.setattr(RunWriter, "write", write_slowly)
    began = time.monotonic()
    counts = [message for message in sent if message[0] is STREAM_COUNTS]
    report = record(tmp_path, [*sent[:100], *counts]).close()
    assert time.monotonic() - began > 1.5
    assert n_sent(read_bag(report.path)) == 100 + len(counts)


def test_a_full_queue_waits_for_a_slow_disk_as_long_as_it_writes(sent, tmp_path, monkeypatch):
    """One batch, as large as the queue, takes longer than a disk may stall."""
    monkeypatch.setattr(live_module, "STALL_LIMIT", 1.5)  # s, longer than a busy machine pauses
    write = RunWriter.write

    def write_slowly(writer, *message):
        time.sleep(0.02)
        write(writer, *message)

    monkeypatch.setattr(RunWriter, "write", write_slowly)
    batch = sum(len(data) + live_module.MESSAGE_COST for _, data in sent[1:121])
    counts = [message for message in sent if message[0] is STREAM_COUNTS]
    began = time.monotonic()
    recorder = record(tmp_path, [*sent[:300], *counts], queue_bytes=batch)
    assert time.monotonic() - began > 1.5
    assert n_sent(read_bag(recorder.close().path)) == 300 + len(counts)


def test_killed_recorder_leaves_all_but_the_last_half_second(sent, tmp_path, monkeypatch):
    monkeypatch.setattr(live_module, "FLUSH_PERIOD", 0.05)
    recorder = record(tmp_path, sent[:5000])
    # what the operating system has is what a kill -9 leaves: soon, all
    copy, deadline = tmp_path / "copy.mcap", time.monotonic() + 600.0
    while True:
        copy.write_bytes((tmp_path / f"{NAME}.mcap").read_bytes())
        run = read_bag(copy)
        if n_sent(run) == 5000:
            break
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert not run.complete
    recorder.close()


def test_message_after_the_end_is_refused(sent, tmp_path):
    recorder = record(tmp_path, sent)
    assert recorder.close() is recorder.close()
    with pytest.raises(RecordingError, match="closed"):
        recorder.take(*sent[5])


def test_bytes_that_are_no_message_are_refused(sent, tmp_path):
    recorder = record(tmp_path, sent[:1])
    with pytest.raises(RecordingError):
        recorder.take(BENCH_STATE, b"\0\1\0\0")
    with pytest.raises(RecordingError):
        recorder.take(STREAM_COUNTS, b"\0\1\0\0\xff")


# a recorder of some topics


def test_recorder_told_which_topics(sent, tmp_path):
    recorder = record(tmp_path, sent, topics=[BENCH_STATE, CAPTURE_STATUS])
    assert recorder.done
    report = recorder.close()
    assert report.complete
    run = read_bag(report.path)
    assert run.complete
    kept = {"/bench/state", "/capture/status", "/bench/run_info", "/bench/stream_counts"}
    assert set(run.topics) == kept
    assert run.topics["/bench/state"] == sum(topic is BENCH_STATE for topic, _ in sent)


def test_name_that_another_recorder_takes_first(sent, tmp_path, monkeypatch):
    # between the look for a free name and the file
    taken = tmp_path / f"{NAME}.mcap"
    taken.write_text("another's")
    looks = iter([taken])
    monkeypatch.setattr(live_module, "free_path", lambda path: next(looks, None) or free_path(path))
    report = record(tmp_path, sent).close()
    assert report.path == taken.with_stem(f"{NAME}_2")
    assert report.complete
    assert taken.read_text() == "another's"


def test_folder_is_read_in_order_with_and_without_metadata(path, tmp_path):
    folder = in_two_files(path, tmp_path / "bag", 3.0)
    whole = read_bag(path)
    for _ in range(2):
        run = read_bag(folder)
        assert run.complete
        for name in run.topics:
            assert run.raw(name) == whole.raw(name)
        assert {n for n, count in whole.topics.items() if count} == set(run.topics)
        (folder / "metadata.yaml").unlink(missing_ok=True)  # as a kill leaves it
    (folder / "bag_1.mcap").rename(folder / "bag_10.mcap")
    copied(path, folder / "bag_9.mcap", topics=["/nothing"])
    assert bits(read_bag(folder).samples) == bits(whole.samples)


# small parts


def test_sequence_and_stamp_are_read_from_the_bytes(sent):
    seen = {}
    for topic, data in sent:
        if topic.sequenced:
            assert sequence_of(topic, data) == seen.get(topic, 0)
            seen[topic] = seen.get(topic, 0) + 1
        else:
            assert sequence_of(topic, data) is None
        assert (stamp_of(topic, data) is None) == (topic is STREAM_COUNTS)
    assert {BENCH_STATE, BENCH_EVENT, CAPTURE_STATUS} <= set(seen)


def test_completeness_names_gaps():
    completeness = Completeness()
    for seq in (0, 1, 4, 5, 9):
        completeness.add(BENCH_STATE, seq)
    assert completeness.problems() == ["bench/state: 5 messages missing (seq 2 to 3, 6 to 8)"]
    for _ in range(2):  # the second time does not count
        completeness.end("simulator", {"bench/state": 12})
    assert not completeness.satisfied
    assert completeness.problems() == [
        "bench/state: 7 messages missing (seq 2 to 3, 6 to 8, 10 to 11)"
    ]
    # as a follower says it of itself
    completeness.end("launcher", {}, complete=False, reason="ended early: reset")
    assert completeness.problems()[0] == "launcher ended the run early: reset"


def test_completeness_needs_the_last_message_of_a_topic_that_holds_a_state():
    """S12: without pacing DDS replaced one of two phases that followed each other at once."""
    completeness = Completeness()
    for seq in (0, 2):
        completeness.add(LAUNCHER_PHASE, seq)
    completeness.end("launcher", {"launcher/phase": 4})
    assert not completeness.satisfied
    assert completeness.problems() == ["launcher/phase: last message missing"]
    completeness.add(LAUNCHER_PHASE, 3)
    assert completeness.satisfied
    assert completeness.problems() == []


def test_completeness_knows_a_late_beginning_from_a_loss():
    def told(numbers, sent):
        completeness = Completeness()
        for seq in numbers:
            completeness.add(BENCH_STATE, seq)
        completeness.end("simulator", {"bench/state": sent})
        return completeness.problems()

    assert told(range(7, 12), sent=5) == []  # a replay from the middle on
    assert told(range(7, 12), sent=12) == ["bench/state: 7 messages missing (seq 0 to 6)"]
    # a repeated message does not stand for a lost one
    assert told([0, 1, 1, 3], sent=4)[0] == "bench/state: 1 messages missing (seq 2)"


def test_columns_of_texts_and_sequences_whose_length_varies():
    make = Messages()
    # the second and the third are as long as each other, and their texts are not
    texts = ["", "a", "bc", "a", "bcde" * 100, "é"]
    ids = ["r", "bc", "a", "", "rr", "r"]
    counts = [{}, {"a": 1}, {"b": 2}, {"bc": 2, "d": 3}, {"e": 4}, {"f": 5}]
    messages = [
        make.serialise(make.stream_counts(*texts_and_counts))
        for texts_and_counts in zip(texts, ids, counts, strict=True)
    ]
    assert len(messages[1]) == len(messages[2])
    found = columns(typestore(), STREAM_COUNTS.type_name, messages)
    assert found["publisher"].tolist() == texts
    assert found["topics"].tolist() == [list(count) for count in counts]
    assert [row.tolist() for row in found["counts"]] == [list(c.values()) for c in counts]


def test_columns_of_a_message_that_does_not_fit_are_refused(sent):
    data = next(data for topic, data in sent if topic is JOINT_STATES)
    for broken in (data[:-9], data + b"\0" * 8, b"\0\0" + data[2:], data[:20]):
        with pytest.raises(RecordingError):
            columns(typestore(), JOINT_STATES.type_name, [broken])


def test_topic_of_another_type_does_not_tell_how_the_run_ended(tmp_path):
    with BagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kind = "std_msgs/msg/Float64"
        topic = writer.add_connection("/bench/stream_counts", kind, typestore=typestore())
        data = typestore().serialize_cdr(typestore().types[kind](1.0), kind)
        writer.write(topic, 10**9, bytes(data))
    run = read_bag(tmp_path / "bag")
    assert (run.problems, run.cut) == ((), False)
