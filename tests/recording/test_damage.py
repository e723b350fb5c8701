"""Damaged recordings: everything before the damage is read, and the loss is reported."""

from __future__ import annotations

import json
from collections import Counter

import pytest
from bags import copied, in_two_files
from cases import cases
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

import capture_sim
from capture_sim.cli import main
from capture_sim.commands.results_folder import Recorded, ResultsFolder
from capture_sim.errors import RecordingError
from capture_sim.recording.bag import read_bag
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.run.summary_table import table as table_of
from capture_sim.viewing.source import headline

#: Damaged files of each kind; docs/evidence/node_suite.md has 50.
CASES = cases(few=4, all=10)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    result = capture_sim.simulate(capture_sim.load_scene("tilt_m10"), t_end=1.5)
    return write_run(result, tmp_path_factory.mktemp("runs") / "tilt_m10.mcap", run_id="a run")


@pytest.fixture(scope="module")
def chunks(path):
    """Place and messages of every chunk, as the library reads them."""
    return expected(path)


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    return tmp_path_factory.mktemp("broken") / "broken.mcap"


def expected(path):
    """Return start, end and messages of each chunk of a file, by the library's own readers."""
    topics, contents = {}, []
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        file.seek(0)
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            if not isinstance(record, Chunk):
                continue
            messages = []
            for inner in breakup_chunk(record):
                if isinstance(inner, Channel):
                    topics[inner.id] = inner.topic
                elif isinstance(inner, Message):
                    messages.append((topics[inner.channel_id], inner.data))
            contents.append(messages)
    places = [(i.chunk_start_offset, i.chunk_length) for i in summary.chunk_indexes]
    return [
        (start, start + length, messages)
        for (start, length), messages in zip(places, contents, strict=True)
    ]


def damaged(file, data):
    file.write_bytes(data)
    return file


def changed(path, file, at):
    """A copy of a file with a bit changed."""
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    return damaged(file, bytes(data))


def messages_in(path):
    """How often each message is in a file."""
    bag = read_bag(path)
    return Counter((topic, data) for topic in bag.topics for data in bag.raw(topic))


def cut(data, first, last, bit):
    return data[:last], last


def flipped(data, first, last, bit):
    return data[:first] + bytes([data[first] ^ 1 << bit]) + data[first + 1 :], first


def zeroed(data, first, last, bit):
    length = min(last - first, 5000)
    return data[:first] + bytes(length) + data[first + length :], first


def swapped(data, first, last, bit):
    half = min(last - first, 5000) // 2
    a, b = data[first : first + half], data[first + half : first + 2 * half]
    return data[:first] + b + a + data[first + 2 * half :], first


def continued(data, first, last, bit):
    return data + data[first : first + 5000], len(data)


@pytest.mark.parametrize("damage", [cut, flipped, zeroed, swapped, continued])
@given(shares=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)), bit=st.integers(0, 7))
@settings(
    max_examples=CASES,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_all_before_the_damage_is_read_and_a_loss_is_reported(
    damage, shares, bit, path, chunks, broken
):
    """Every chunk before the damage, no message that was not there, and a line for a loss."""
    data = path.read_bytes()
    first, last = sorted(min(int(share * len(data)), len(data) - 1) for share in shares)
    bad, at = damage(data, first, last, bit)
    damaged(broken, bad)
    before = Counter(message for _, end, messages in chunks if end <= at for message in messages)
    every = Counter(message for _, _, messages in chunks for message in messages)
    try:
        bag = read_bag(broken)
        read, problems = messages_in(broken), bag.problems
    except RecordingError:
        assert not before
    else:
        assert before <= read <= every
        assert problems or read == every  # a byte of the index loses nothing
        assert all("\n" not in line for line in problems)


def test_damage_is_reported_by_byte_counts_and_last_time(path, chunks, broken):
    """In a chunk in the middle: the index at the end tells how many messages follow it."""
    start, end, _ = chunks[len(chunks) // 2]
    run = read_bag(changed(path, broken, (start + end) // 2))
    before = [messages for _, e, messages in chunks if e <= start]
    count, total = sum(map(len, before)), sum(len(messages) for *_, messages in chunks)
    assert sum(run.topics.values()) == count
    (line,) = run.damage
    # the messages' indexes of the chunk before come between
    assert line.startswith("read up to byte ")
    assert 0 <= start - int(line.split()[4]) < 10
    assert f"of {path.stat().st_size} (" in line
    last = max(run.log_times(topic).max(initial=0) for topic in run.topics)
    seconds = last / 1e9 - 1.0
    assert f": {count} of {total} messages, the last {seconds:.3f} s after the first" in line
    assert run.samples["t"][-1] == pytest.approx(seconds, abs=1e-9)
    assert run.scene == read_bag(path).scene
    assert run.metadata["run_id"] == "a run"
    # a copy that is cut there has no index that could tell
    (line,) = read_bag(damaged(broken, path.read_bytes()[: end - 10])).damage
    assert f"(incomplete record): {count} messages, the last" in line


def test_a_number_that_no_checksum_confirms_is_not_shown(path, broken):
    data = path.read_bytes()
    at = data.rindex(b"wall_time")
    run = read_bag(changed(path, broken, at + 15))
    assert run.wall_time is None
    assert not run.complete
    for back in (3, 20, 700):  # the index after it
        run = read_bag(changed(path, broken, len(data) - back))
        assert run.wall_time == read_bag(path).wall_time


@pytest.mark.parametrize(
    "how",
    [
        {"chunk_size": 30_000, "compression": CompressionType.LZ4},
        {"chunk_size": 30_000, "enable_crcs": False},  # as rosbag2's fast writing
        {"use_chunking": False},
    ],
    ids=["lz4", "no checksums", "no chunks"],
)
def test_half_of_a_file_of_another_writer_is_read(how, path, tmp_path, broken):
    messages, file = read_bag(path).raw("bench/state")[:500], tmp_path / "foreign.mcap"
    with file.open("wb") as stream:
        writer = Writer(stream, **how)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/hello", "cdr", schema)
        for i, data in enumerate(messages):
            writer.add_message(channel, 10 + i, data, 10 + i, i)
        writer.finish()
    assert read_bag(file).damage == ()
    data = file.read_bytes()
    half = read_bag(damaged(broken, data[: len(data) // 2]))
    n = half.topics["/hello"]
    assert 0 < n < 500
    assert len(half.damage) == 1
    assert half.raw("/hello") == messages[:n]


def test_each_file_of_a_folder_is_read_up_to_its_damage(path, tmp_path):
    folder = in_two_files(path, tmp_path / "bag", 1.0)
    assert read_bag(folder).samples.tobytes() == read_bag(path).samples.tobytes()
    first, second = sorted(folder.glob("*.mcap"))
    first.write_bytes(first.read_bytes()[: len(first.read_bytes()) * 3 // 4])
    assert messages_in(folder) == messages_in(first) + messages_in(second)
    assert read_bag(folder).damage[0].startswith(f"{first.name}: read up to byte")


def test_results_of_a_cut_recording_are_marked(path, broken, tmp_path, capsys):
    """In the table, printed and kept, in the numbers, the picture's title and the report."""
    data = path.read_bytes()
    run = read_run(damaged(broken, data[: len(data) // 2]))
    ResultsFolder(tmp_path).add([Recorded(run, None)])
    reason = run.problems[0]
    for table in (capsys.readouterr().out, (tmp_path / "results.txt").read_text()):
        assert "\n  INCOMPLETE\n" in table
        assert reason in table
    (summary,) = json.loads((tmp_path / "results.json").read_text())
    assert summary["problems"] == list(run.problems)
    assert "INCOMPLETE: read up to byte" in headline(run)
    assert main(["report", str(broken), "--out", str(tmp_path / "report.html")]) == 0
    assert "INCOMPLETE" in (tmp_path / "report.html").read_text()
    # as a run that had to stop; a whole one bears no mark
    stopped = ["run", "tilt_0", "--set", "run.max_steps=300", "--no-record", "--out", str(tmp_path)]
    assert main(stopped) == 1
    summary = json.loads((tmp_path / "results.json").read_text())[-1]
    assert "max_steps" in summary["problems"][0]
    whole = read_run(path)
    assert whole.summary["problems"] == []
    assert "INCOMPLETE" not in table_of([whole.summary]) + headline(whole)


def test_topic_that_is_not_printable_is_left_out_and_named_safely(path, tmp_path, capfd):
    """A name that moves the cursor or begins a line never reaches the terminal."""
    odd = "/a\x1b[31m\nverdict: captured"

    def beside(topic, data):
        yield topic, "cdr", data
        if topic == "/chaser/odom":
            yield odd, "cdr", data

    file = copied(path, tmp_path / "odd.mcap", change=beside)
    assert read_bag(file).raw("/chaser/odom") == read_bag(path).raw("/chaser/odom")
    for command in (["detect"], ["export", "--out", str(tmp_path / "tables")]):
        main([command[0], str(file), *command[1:]])
        printed = "".join(capfd.readouterr())
        assert "\x1b" not in printed
        assert not any(line.startswith("verdict: captured'") for line in printed.splitlines())
        assert repr(odd) in printed
