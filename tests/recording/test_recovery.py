"""Damaged recordings: what precedes the damage is read and copied, and what is lost is reported."""

from __future__ import annotations

import json
import os
from collections import Counter

import pytest
from bags import copied, in_two_files
from damage import copied_rightly, cuts, expected, flips, messages_in
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import Reader

import capture_sim
from capture_sim.cli import main
from capture_sim.commands.output import report
from capture_sim.errors import RecordingError
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.recording.recover import recover
from capture_sim.results import table as table_of
from capture_sim.viewing.source import headline, summary_of

#: Cuts and flipped bytes; docs/recording_checked.md has 50 of each.
CASES = int(os.environ.get("CAPTURE_SIM_EXAMPLES", "8"))


@pytest.fixture(scope="module")
def result():
    return capture_sim.simulate(capture_sim.load_scene("tilt_m10"))


@pytest.fixture(scope="module")
def path(result, tmp_path_factory):
    return write_run(result, tmp_path_factory.mktemp("runs") / "tilt_m10.mcap", run_id="a run")


@pytest.fixture(scope="module")
def chunks(path):
    """Place and messages of every chunk, as the library reads them."""
    return expected(path)


def damaged(tmp_path, data):
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data)
    return broken


def changed(path, tmp_path, at):
    """A copy of a file with a bit changed."""
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    return damaged(tmp_path, bytes(data))


def test_whole_file_is_copied_whole(path, tmp_path):
    recovery = recover(path, tmp_path / "out.mcap")
    assert recovery.losses == ()
    one, two = read_run(path), read_run(recovery.path)
    assert two.complete
    assert two.topics == one.topics == recovery.messages
    for topic in one.topics:
        assert two.raw(topic) == one.raw(topic)
        assert two.log_times(topic).tolist() == one.log_times(topic).tolist()
    assert two.scene == one.scene
    assert two.metadata == one.metadata
    assert two.wall_time == one.wall_time


def test_cut_files(path, chunks, tmp_path):
    for data, at in cuts(path, CASES, 0):
        assert copied_rightly(damaged(tmp_path, data), chunks, at)


def test_flipped_bytes(path, chunks, tmp_path):
    for data, at in flips(path, CASES, 0):
        assert copied_rightly(damaged(tmp_path, data), chunks, at)


def test_damage_is_reported_by_byte_counts_and_last_time(path, chunks, tmp_path):
    """In a chunk in the middle: what is behind it is not read, the index tells how much it was."""
    start, end, _ = chunks[len(chunks) // 2]
    run = read_run(changed(path, tmp_path, (start + end) // 2))
    before = [messages for _, e, messages in chunks if e <= start]
    count, total = sum(map(len, before)), sum(len(messages) for *_, messages in chunks)
    assert sum(run.topics.values()) == count
    (line,) = run.damage
    size = path.stat().st_size
    # the messages' indexes of the chunk before come between
    assert line.startswith("read up to byte ")
    assert 0 <= start - int(line.split()[4]) < 10
    assert f"of {size} (" in line
    assert "a chunk" in line
    last = max(run.log_times(topic).max(initial=0) for topic in run.topics)
    assert (
        f": {count} of {total} messages, the last {last / 1e9 - 1.0:.3f} s after the first" in line
    )
    assert run.samples["t"][-1] == pytest.approx(last / 1e9 - 1.0, abs=1e-9)
    assert run.scene == capture_sim.load_scene("tilt_m10")
    assert run.metadata["run_id"] == "a run"
    # a copy that is cut there has no index that could tell
    (line,) = read_run(damaged(tmp_path, path.read_bytes()[: end - 10])).damage
    assert f"(incomplete record): {count} messages, the last" in line


def test_damaged_index_loses_nothing(path, tmp_path):
    whole = messages_in(path)
    for back in (3, 20, 700):
        run = read_run(changed(path, tmp_path, path.stat().st_size - back))
        assert sum(run.topics.values()) == whole.total()
        assert run.wall_time == read_run(path).wall_time
    broken = damaged(tmp_path, path.read_bytes()[:-500])
    (line,) = read_run(broken).problems
    assert f": {whole.total()} messages, the last" in line
    recovery = recover(broken)
    assert messages_in(recovery.path) == whole
    assert read_run(recovery.path).problems == (f"not recovered: {line}",)


def test_number_that_no_checksum_confirms_is_not_shown(path, tmp_path):
    data = path.read_bytes()
    broken = changed(path, tmp_path, data.index(b"wall_time") + 20)  # within the number
    run = read_run(broken)
    assert "outside the chunks" in run.damage[0]
    assert run.wall_time is None
    again = read_run(recover(broken).path)
    assert again.wall_time is None
    assert messages_in(again.path) == messages_in(path)
    # nor is a scene: the announcement among the messages contains it too
    broken = changed(path, tmp_path, data.index(b"scene.yaml") + 400)
    assert read_run(broken).scene == read_run(path).scene


def test_recovered_file_is_read_by_others_and_reports_what_it_lacks(path, tmp_path):
    data = path.read_bytes()
    recovery = recover(damaged(tmp_path, data[: len(data) * 2 // 3]))
    with Reader(recovery.path) as reader:
        assert reader.message_count == sum(recovery.messages.values())
    with recovery.path.open("rb") as file:
        count = sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
    assert count == sum(recovery.messages.values())
    run = read_run(recovery.path)
    assert run.problems[0] == f"not recovered: {recovery.losses[0]}"
    assert run.metadata["run_id"] == "a run"
    assert run.scene == capture_sim.load_scene("tilt_m10")
    # damaged once more, it reports both
    data = recovery.path.read_bytes()
    twice = recover(damaged(tmp_path, data[: -len(data) // 3]), tmp_path / "twice.mcap")
    assert len(read_run(twice.path).problems) > len(twice.losses) == 1


def foreign(file, messages, encodings=("cdr",), topic="/hello", **how):
    """A file of another writer, of one topic; ``how`` is the writer's."""
    with file.open("wb") as stream:
        writer = Writer(stream, **how)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        for encoding in encodings:
            channel = writer.register_channel(topic, encoding, schema)
            for i, data in enumerate(messages):
                writer.add_message(channel, 10 + i, data, 10 + i, i)
        writer.finish()
    return file


@pytest.mark.parametrize(
    "how",
    [
        {"chunk_size": 30_000, "compression": CompressionType.LZ4},
        {"chunk_size": 30_000, "enable_crcs": False},  # as rosbag2's fast writing
        {"use_chunking": False},
    ],
    ids=["lz4", "no checksums", "no chunks"],
)
def test_half_of_a_foreign_file_is_copied(how, path, tmp_path):
    messages = read_run(path).raw("bench/state")[:500]
    file = foreign(tmp_path / "foreign.mcap", messages, **how)
    assert recover(file).losses == ()
    data = file.read_bytes()
    recovery = recover(damaged(tmp_path, data[: len(data) // 2]))
    n = recovery.messages["/hello"]
    assert 0 < n < 500
    assert read_run(recovery.path).raw("/hello") == messages[:n]


def test_encodings_of_one_topic_stay_apart(tmp_path):
    recovery = recover(foreign(tmp_path / "both.mcap", [b"text"] * 5, encodings=("cdr", "json")))
    with recovery.path.open("rb") as stream:
        kept = Counter(
            channel.message_encoding for _, channel, _ in make_reader(stream).iter_messages()
        )
    assert recovery.messages == {"/hello": 10}
    assert kept == {"cdr": 5, "json": 5}


def test_folder_is_copied_into_one_file(path, tmp_path):
    folder = in_two_files(path, tmp_path / "bag", 3.0)
    recovery = recover(folder)
    assert recovery.losses == ()
    assert recovery.messages == {n: c for n, c in read_run(path).topics.items() if c}
    assert read_run(recovery.path).samples.tobytes() == read_run(path).samples.tobytes()
    # of a file that is damaged what precedes the damage is copied, the next is copied whole
    first, second = sorted(folder.glob("*.mcap"))
    first.write_bytes(first.read_bytes()[:-200_000])
    recovery = recover(folder)
    assert [line.split(":")[0] for line in recovery.losses] == [first.name]
    assert messages_in(recovery.path) == messages_in(first) + messages_in(second)
    assert read_run(folder).damage[0].startswith(f"{first.name}: read up to byte")
    second.unlink()
    assert any("bag_1.mcap: cannot read" in line for line in recover(folder).losses)


def test_nothing_to_copy_and_nowhere_to_copy_it(path, tmp_path):
    data = path.read_bytes()
    with pytest.raises(RecordingError, match="nothing to recover: read up to byte"):
        recover(damaged(tmp_path, data[:3000]))
    with pytest.raises(RecordingError, match="not an MCAP file"):
        recover(damaged(tmp_path, b"hello"))
    existing = tmp_path / "there.mcap"
    existing.write_text("mine")
    with pytest.raises(RecordingError, match="cannot write"):
        recover(path, existing)
    assert existing.read_text() == "mine"


def test_command_reports_what_it_copied_and_what_is_lost(path, tmp_path, capsys):
    data = path.read_bytes()
    broken = damaged(tmp_path, data[: len(data) // 2])
    assert main(["recover", str(broken)]) == 0
    printed = capsys.readouterr().out
    assert "broken_recovered.mcap" in printed
    assert "/bench/state: " in printed
    assert "lost: read up to byte" in printed
    assert main(["recover", str(path), "--out", str(tmp_path / "whole.mcap")]) == 0
    assert capsys.readouterr().out.endswith("lost: nothing\n")
    assert main(["recover", str(damaged(tmp_path, data[:3000]))]) == 1
    assert main(["recover", str(tmp_path / "nowhere.mcap")]) == 2
    assert capsys.readouterr().err.count("\n") == 2


def test_results_of_a_cut_recording_are_marked(path, tmp_path, capsys):
    """In the table, printed and kept, in the numbers, the picture's title and the report."""
    data = path.read_bytes()
    broken = damaged(tmp_path, data[: len(data) // 2])
    run = read_run(broken)
    report([summary_of(run, run.wall_time)], tmp_path)
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
    (summary,) = json.loads((tmp_path / "results.json").read_text())
    assert "max_steps" in summary["problems"][0]
    whole = read_run(path)
    assert summary_of(whole, None)["problems"] == []
    assert "INCOMPLETE" not in table_of([summary_of(whole, None)]) + headline(whole)


def test_topic_that_is_not_printable_is_left_out_and_named_safely(path, tmp_path, capfd):
    """A name that moves the cursor or begins a line never reaches the terminal."""
    odd = "/a\x1b[31m\nverdict: captured"

    def beside(topic, data):
        yield topic, "cdr", data
        if topic == "/chaser/odom":
            yield odd, "cdr", data

    file = copied(path, tmp_path / "odd.mcap", change=beside)
    assert read_run(file).raw("/chaser/odom") == read_run(path).raw("/chaser/odom")
    recovery = recover(file, tmp_path / "out.mcap")
    assert odd not in recovery.messages
    assert read_run(recovery.path).left_out == ()
    for command in (["recover"], ["detect"], ["export", "--out", str(tmp_path / "tables")]):
        main([command[0], str(file), *command[1:]])
        printed = "".join(capfd.readouterr())
        assert "\x1b" not in printed
        assert not any(line.startswith("verdict: captured'") for line in printed.splitlines())
        assert repr(odd) in printed
