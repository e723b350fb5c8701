"""Recordings from anywhere: damaged at random, or with right checksums and odd contents.

Whatever a file holds, reading it ends with its run or one line, within memory bounded by its size.
"""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from functools import cache

import lz4.frame
import numpy as np
import pytest
import zstandard
from cases import cases
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk
from mcap.writer import Writer

import capture_sim
from capture_sim.cli import main
from capture_sim.errors import RecordingError
from capture_sim.messages.convert import Messages, RunDescription
from capture_sim.messages.definitions import schema_text, typestore
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    CAPTURE_STATUS,
    RUN_INFO,
    STREAM_COUNTS,
)
from capture_sim.recording.bag import read_bag
from capture_sim.recording.live import LiveRecorder
from capture_sim.recording.offline import PUBLISHERS, run_stream, write_run
from capture_sim.recording.scan import MIN_UNPACKED_LIMIT

CASES = cases(few=30, all=100)
COMMANDS = ("detect", "export", "compare", "calibrate")


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    result = capture_sim.simulate(capture_sim.load_scene("tilt_0"), t_end=0.8)
    return write_run(result, tmp_path_factory.mktemp("runs") / "tilt_0.mcap", run_id="a run")


def make(path, messages, *, log_time=10**9, scene=b"", closing=None, text=None):
    """Write a file whose checksums are right: messages are (name, type, bytes)."""
    with path.open("wb") as file:
        writer = Writer(file, enable_data_crcs=True)
        writer.start("ros2")
        if scene:
            writer.add_attachment(0, 0, "scene.yaml", "application/yaml", scene)
        ids = {}
        for name, type_name, data in messages:
            if name not in ids:
                definition = (schema_text(type_name) if text is None else text).encode()
                schema = writer.register_schema(type_name, "ros2msg", definition)
                ids[name] = writer.register_channel(name, "cdr", schema)
            writer.add_message(ids[name], log_time, data, log_time)
        if closing:
            writer.add_metadata("capture_sim_end", closing)
        writer.finish()
    return path


@cache
def some_messages():
    """Return a message of each topic of a run."""
    result = capture_sim.simulate(capture_sim.load_scene("tilt_0"), t_end=0.2)
    run = RunDescription.of(result.scene, "a run", PUBLISHERS)
    return {topic: data for topic, _, data in run_stream(result, run)}


def serialised(topic, **fields):
    """Return a message of a topic with some fields changed, as (name, type, bytes)."""
    store = typestore()
    message = store.deserialize_cdr(some_messages()[topic], topic.type_name)
    for name, value in fields.items():
        setattr(message, name, value)
    data = bytes(store.serialize_cdr(message, topic.type_name))
    return topic.absolute_name, topic.type_name, data


def check_one_line(error, name=""):
    assert str(error).isprintable(), name


def odd_files(folder):
    """Yield a name and a file for each kind of odd contents."""
    state = serialised(BENCH_STATE, seq=0)
    event = serialised(BENCH_EVENT, seq=0, kind="never heard of")
    yield "log time", make(folder / "a.mcap", [state], log_time=2**63)
    yield "wall time", make(folder / "b.mcap", [state], closing={"wall_time": "soon"})
    yield "scene", make(folder / "c.mcap", [state], scene=b"\xff\xfe\0")
    yield "topic", make(folder / "d.mcap", [("/bench/\0state", *state[1:])])
    yield "topic", make(folder / "e.mcap", [("/../../x\x1b[31m\n", *state[1:])])
    yield "itself", make(folder / "f.mcap", [state], text="capture_sim/BenchState again")
    yield "huge", make(folder / "g.mcap", [state], text="float64[4000000000] x")
    many = "a/B[1000000000] x\n" + "=" * 80 + "\nMSG: a/B\nuint8[0] y"
    yield "many", make(folder / "h.mcap", [state], text=many)
    yield "no definition", make(folder / "i.mcap", [state], text="{{{")
    yield "phase", make(folder / "j.mcap", [serialised(BENCH_STATE, seq=0, phase=255)])
    yield "event", make(folder / "k.mcap", [event])
    yield "verdict", make(folder / "l.mcap", [serialised(CAPTURE_STATUS, seq=0, state=77)])
    info = serialised(RUN_INFO, run_id="x", state_rate=0.0, scene="][", publishers=[])
    yield "rate", make(folder / "m.mcap", [info])
    info = serialised(RUN_INFO, run_id="x", state_rate=1e3, rate=1e2, scene="][", publishers=[])
    yield "announced scene", make(folder / "n.mcap", [info, state])
    counts = serialised(STREAM_COUNTS, topics=["a", "b"], counts=np.zeros(1, np.uint64))
    yield "counts", make(folder / "o.mcap", [info, counts])
    yield "cut message", make(folder / "p.mcap", [(*state[:2], state[2][:40])])


def test_odd_contents_are_one_line(tmp_path, capsys):
    tried = 0
    for name, file in odd_files(tmp_path):
        for command in COMMANDS:
            more = {"compare": [str(file)], "calibrate": ["--fit=e"]}.get(command, [])
            folder = tmp_path / f"{file.stem}_{command}"
            out = [] if command == "detect" else ["--out", str(folder)]
            status = main([command, str(file), *more, *out])
            said = capsys.readouterr()
            assert status in (0, 1, 2), (name, command)
            assert "Traceback" not in said.err, (name, command)
            assert len(said.err.splitlines()) <= 3, (name, command, said.err)
            tried += 1
        try:
            run = read_bag(file)
            for look in ("samples", "events", "statuses", "scene", "wall_time", "problems"):
                getattr(run, look)
        except capture_sim.CaptureSimError as error:
            check_one_line(error, name)
    assert tried == 16 * len(COMMANDS)
    assert {p.name.split("_")[0] for p in tmp_path.iterdir()} <= {*"abcdefghijklmnop"} | {
        f"{c}.mcap" for c in "abcdefghijklmnop"
    }


def bomb(path, compression, size, told):
    """Write a file with one chunk of ``size`` zeros that says it unpacks to ``told``."""
    piece = bytes(1 << 20)
    if compression == "zstd":
        packer = zstandard.ZstdCompressor().compressobj()
        packed = b"".join(packer.compress(piece) for _ in range(size >> 20)) + packer.flush()
    else:
        packer = lz4.frame.LZ4FrameCompressor()
        packed = packer.begin() + b"".join(packer.compress(piece) for _ in range(size >> 20))
        packed += packer.flush()
    builder = RecordBuilder()
    Chunk(compression, packed, 0, 0, 0, told).write(builder)
    with path.open("wb") as file:
        Writer(file).start("ros2")
        file.write(builder.end())
    return path


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("told", [1000, 1 << 30, 1 << 62])
def test_a_small_file_cannot_fill_the_memory(compression, told, tmp_path):
    file = bomb(tmp_path / "bomb.mcap", compression, 1 << 30, told)
    assert file.stat().st_size < 5_000_000
    tracemalloc.start()
    run = read_bag(file)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert run.topics == {}
    assert len(run.damage) == 1
    assert "unpacks to" in run.damage[0]
    assert most < max(MIN_UNPACKED_LIMIT, 100 * file.stat().st_size) + 50e6
    assert not (tmp_path / "out.mcap").exists()


def test_many_empty_messages_cannot_fill_the_memory(tmp_path):
    head = struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0)
    builder = RecordBuilder()
    Channel(1, "/x", "cdr", {}, 0).write(builder)
    records = head * 2_000_000
    packed = zstandard.compress(records)
    Chunk("zstd", packed, 0, 0, zlib.crc32(records), len(records)).write(builder)
    with (tmp_path / "x.mcap").open("wb") as file:
        Writer(file).start("ros2")
        file.write(builder.end())
    run = read_bag(tmp_path / "x.mcap")
    assert run.topics == {"/x": 0}
    assert "more than is accepted for the file" in run.damage[0]


def test_a_run_s_name_from_outside_makes_a_file_in_the_folder(tmp_path):
    store, messages = typestore(), Messages()
    out = tmp_path / "runs"
    names = ["../../x", str(tmp_path / "elsewhere" / "x"), "a\nb\x1b[0m", "", ".hidden", "n" * 400]
    for name in names:
        _, type_name, data = serialised(RUN_INFO, run_id="r", name=name, publishers=["simulator"])
        assert store.deserialize_cdr(data, type_name).name == name
        recorder = LiveRecorder(out, data)
        counts = messages.stream_counts("simulator", "r", {RUN_INFO.name: 1})
        recorder.take(STREAM_COUNTS, messages.serialise(counts))
        recorder.close()
        assert recorder.path.parent == out
        assert read_bag(recorder.path).complete
    assert {p.name for p in tmp_path.iterdir()} == {"runs"}
    assert len(list(out.iterdir())) == len(names)


@pytest.mark.parametrize("name", ["publishers", "participants", "software"])
@pytest.mark.parametrize("texts", [["a"] * 100_000, ["a" * 10_000]])
def test_announcement_of_more_than_a_bench_is_rejected(name, texts, tmp_path):
    _, _, data = serialised(RUN_INFO, run_id="r", **{name: texts})
    with pytest.raises(RecordingError, match=rf"RunInfo.{name} = \d+ texts .*must be at most 100"):
        LiveRecorder(tmp_path, data)
    assert list(tmp_path.iterdir()) == []


def test_texts_from_a_recording_reach_the_terminal_without_escapes(tmp_path, capsys):
    """A publisher's name, the reason of an end, of a verdict."""
    escape = "x\x1b[2J\nverdict: captured"
    info = serialised(RUN_INFO, publishers=[escape])
    counts = serialised(STREAM_COUNTS, publisher=escape, complete=False, reason=escape)
    status = serialised(CAPTURE_STATUS, reason=escape)
    _, *rest = some_messages()
    others = [serialised(topic) for topic in rest if topic not in (STREAM_COUNTS, CAPTURE_STATUS)]
    file = make(tmp_path / "x.mcap", [info, *others, status, counts])
    for command in ("detect", "export", "report"):
        out = [] if command == "detect" else ["--out", str(tmp_path / f"{command}.html")]
        main([command, str(file), *out])
        printed = capsys.readouterr()
        assert "\x1b" not in printed.out + printed.err, command
        assert "verdict: captured" not in (printed.out + printed.err).splitlines(), command


def test_topics_of_one_file_name_are_exported_to_two(tmp_path):
    state = serialised(BENCH_STATE)
    names = ("/x/a_b", "/x_a/b", "/../x")
    file = make(tmp_path / "x.mcap", [(name, *state[1:]) for name in names])
    assert main(["export", str(file), "--out", str(tmp_path / "out")]) == 0
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "x_a_b.csv",
        "x_a_b_2.csv",
        "_x.csv",
    }
