"""Damaged recordings: every whole chunk is saved, nothing wrong is, and what is lost is told."""

from __future__ import annotations

import os
import re
from collections import Counter

import numpy as np
import pytest
from bags import copied
from damage import cuts, expected, flips, saved_rightly
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import Reader

import capture_sim
from capture_sim.cli import main
from capture_sim.errors import RecordingError
from capture_sim.messages.topics import topic_named
from capture_sim.recording.live import LiveRecorder, Split
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run
from capture_sim.recording.recover import recover

#: Cuts and flipped bytes; docs/recording.md has 50 of each.
CASES = int(os.environ.get("CAPTURE_SIM_EXAMPLES", "8"))
#: How the stretch is told that lost messages may have been in.
TIMES = r"any messages between ([\d.]+) s and ([\d.]+) s since the release"


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


def test_whole_file_is_saved_whole(path, tmp_path):
    saved = recover(path, tmp_path / "out.mcap")
    assert saved.losses == ()
    one, two = read_run(path), read_run(saved.path)
    assert two.complete
    assert two.topics == one.topics == saved.messages
    for topic in one.topics:
        assert two.raw(topic) == one.raw(topic)
        assert two.log_times(topic).tolist() == one.log_times(topic).tolist()
    assert two.scene == one.scene
    assert two.metadata == one.metadata
    assert two.wall_time == one.wall_time


def test_cut_files(path, chunks, tmp_path):
    for data, at in cuts(path, CASES, 0):
        assert saved_rightly(damaged(tmp_path, data), chunks, cut=at)


def test_flipped_bytes(path, chunks, tmp_path):
    for data, at in flips(path, CASES, 0):
        assert saved_rightly(damaged(tmp_path, data), chunks, flipped=at)


def test_lost_first_chunk_does_not_take_the_names_with_it(path, chunks, tmp_path):
    (start, end, _), *others = chunks
    data = bytearray(path.read_bytes())
    data[(start + end) // 2] ^= 16
    for broken in (bytes(data), bytes(data[: others[5][0] + 10])):  # with and without summary
        saved = recover(damaged(tmp_path, broken))
        count = sum(len(messages) for _, end, messages in others if end <= len(broken))
        assert sum(saved.messages.values()) == count
        run = read_run(saved.path)
        assert run.scene == capture_sim.load_scene("tilt_m10")
        assert not run.complete


def test_holes_and_rubbish(path, chunks, tmp_path):
    # several chunks gone, others behind rubbish: the rest is found by its checksums
    data = path.read_bytes()
    rng = np.random.default_rng(1)
    rubbish = rng.integers(256, size=5000, dtype=np.uint8).tobytes()
    (a, b), (c, d) = (chunks[i][:2] for i in (3, 9))
    broken = data[:a] + rubbish + data[b:c] + rubbish[:77] + data[d : chunks[-1][0] + 40]
    saved = recover(damaged(tmp_path, broken))
    kept = [messages for i, (_, _, messages) in enumerate(chunks[:-1]) if i not in (3, 9)]
    assert sum(saved.messages.values()) == sum(map(len, kept))
    assert len(saved.losses) >= 3


def test_recovered_file_is_read_by_others_and_says_what_it_lacks(path, tmp_path):
    data = path.read_bytes()
    saved = recover(damaged(tmp_path, data[: len(data) * 2 // 3]))
    with Reader(saved.path) as reader:
        assert reader.message_count == sum(saved.messages.values())
    with saved.path.open("rb") as file:
        count = sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())
    assert count == sum(saved.messages.values())
    run = read_run(saved.path)
    assert any(line.startswith("not recovered: ") for line in run.problems)
    # the run's description is confirmed by its announcement, which has a checksum
    assert run.metadata["run_id"] == "a run"
    assert run.scene == capture_sim.load_scene("tilt_m10")


def test_metadata_without_checksum_is_marked(path, tmp_path):
    data = path.read_bytes()
    at = data.index(b"wall_time") + 20  # within the number
    changed = bytearray(data)
    changed[at] ^= 1
    saved = recover(damaged(tmp_path, changed))
    assert any("capture_sim_end, which has no" in line for line in saved.unconfirmed)
    assert read_run(saved.path).wall_time is None


def foreign(file, messages, encodings=("cdr",), **how):
    """A file of another writer, of one topic; ``how`` is the writer's."""
    with file.open("wb") as stream:
        writer = Writer(stream, **how)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        for encoding in encodings:
            channel = writer.register_channel("/hello", encoding, schema)
            for i, data in enumerate(messages):
                writer.add_message(channel, 10 + i, data, 10 + i, i)
        writer.finish()
    return file


def half_of(file, tmp_path, messages):
    """Save the first half of a foreign file: what is saved are its first messages."""
    data = file.read_bytes()
    saved = recover(damaged(tmp_path, data[: len(data) // 2]))
    n = saved.messages["/hello"]
    assert 0 < n < 500
    assert read_run(saved.path).raw("/hello") == messages[:n]


def test_others_files_are_saved_too(path, tmp_path):
    """LZ4, its own chunk size, definitions only where first needed."""
    messages = read_run(path).raw("bench/state")[:500]
    lz4 = {"chunk_size": 30_000, "compression": CompressionType.LZ4}
    half_of(foreign(tmp_path / "foreign.mcap", messages, **lz4), tmp_path, messages)


def test_files_without_checksums_are_saved_and_marked(path, tmp_path, capsys):
    """rosbag2's fast writing leaves them out; what nothing confirms must not pass for whole."""
    messages = read_run(path).raw("bench/state")[:500]
    plain = foreign(tmp_path / "plain.mcap", messages, chunk_size=30_000, enable_crcs=False)
    saved = recover(plain)
    assert read_run(saved.path).raw("/hello") == messages
    chunks = saved.chunks
    assert saved.unconfirmed[0] == f"{chunks} of {chunks} chunks, which have no checksum"
    assert saved.losses == ()
    said = [f"unconfirmed: {line}" for line in saved.unconfirmed]
    assert list(read_run(saved.path).problems) == said
    assert main(["recover", str(plain)]) == 0
    assert capsys.readouterr().out.splitlines()[-len(said) :] == said
    half_of(plain, tmp_path, messages)


def test_whole_file_of_others_is_not_called_damaged(tmp_path):
    file = foreign(tmp_path / "foreign.mcap", [b"text"])
    assert not any("damaged" in line for line in recover(file).losses)
    mark = b"\x0f" + (4).to_bytes(8, "little") + bytes(4)  # what is damaged is called so still
    changed = file.read_bytes().replace(mark, mark[:-4] + b"\1\2\3\4")
    assert any("damaged" in line for line in recover(damaged(tmp_path, changed)).losses)


def test_encodings_of_one_topic_stay_apart(tmp_path):
    saved = recover(foreign(tmp_path / "both.mcap", [b"text"] * 5, encodings=("cdr", "json")))
    with saved.path.open("rb") as stream:
        kept = Counter(
            channel.message_encoding for _, channel, _ in make_reader(stream).iter_messages()
        )
    assert saved.messages == {"/hello": 10}
    assert kept == {"cdr": 5, "json": 5}


def split_in_seven(path, folder):
    """The run in a folder, a second in each file."""
    recorder = LiveRecorder(folder, split=Split(time=1.0))
    with path.open("rb") as file:
        topics = {}
        for record in StreamReader(file).records:
            if isinstance(record, Message):
                recorder.take(topic_named(topics[record.channel_id]), record.data)
            elif hasattr(record, "topic"):
                topics[record.id] = record.topic
    folder = recorder.close().path
    assert len(list(folder.glob("*.mcap"))) == 7
    return folder


def test_split_recording_is_saved_into_one_file(path, tmp_path):
    run, folder = read_run(path), split_in_seven(path, tmp_path)
    metadata = (folder / "metadata.yaml").read_bytes()
    (folder / "metadata.yaml").unlink()  # as after a kill
    saved = recover(folder)
    assert saved.losses == ()
    assert saved.messages == run.topics
    again = read_run(saved.path)
    assert again.samples.tobytes() == run.samples.tobytes()
    # parts that are gone are named, with and without metadata
    (folder / "tilt_m10_2.mcap").unlink()
    saved = recover(folder)
    assert "part 2 of the recording is not there" in saved.losses
    assert not read_run(saved.path).complete
    (folder / "metadata.yaml").write_bytes(metadata)
    saved = recover(folder)
    assert any("tilt_m10_2.mcap: cannot read" in line for line in saved.losses)
    assert sum(saved.messages.values()) > 0


def test_nothing_to_save_and_nowhere_to_save_it(path, tmp_path):
    data = path.read_bytes()
    with pytest.raises(RecordingError, match="no whole chunk"):
        recover(damaged(tmp_path, data[:3000]))
    with pytest.raises(RecordingError, match="not an MCAP file"):
        recover(damaged(tmp_path, b"hello"))
    existing = tmp_path / "there.mcap"
    existing.write_text("mine")
    with pytest.raises(RecordingError, match="cannot write"):
        recover(path, existing)
    assert existing.read_text() == "mine"


def test_command_says_what_it_saved_and_what_is_lost(path, tmp_path, capsys):
    data = path.read_bytes()
    broken = damaged(tmp_path, data[: len(data) // 2])
    assert main(["recover", str(broken)]) == 0
    said = capsys.readouterr().out
    assert "broken_recovered.mcap" in said
    assert "/bench/state: " in said
    assert "lost: the file ends within a record" in said
    assert main(["recover", str(tmp_path / "nowhere.mcap")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_times_of_what_is_lost_count_from_the_release(path, tmp_path):
    """As the samples' do: those that are missing lie in the interval that is named."""
    # a log by the wall's clock has the same
    later = copied(path, tmp_path / "later.mcap", late=1_700_000_000, chunk_size=100_000)
    whole = read_run(path).samples["t"]
    for file in (path, later):
        parts = expected(file)
        start, end, _ = parts[len(parts) // 2]
        data = bytearray(file.read_bytes())
        data[(start + end) // 2] ^= 4
        saved = recover(damaged(tmp_path, bytes(data)))
        (told,) = (re.search(TIMES, line) for line in saved.losses if re.search(TIMES, line))
        after, before = map(float, told.groups())
        missing = np.setdiff1d(whole, read_run(saved.path).samples["t"])
        assert missing.size
        assert after - 0.0015 <= missing.min() <= missing.max() <= before + 0.0015
        assert before - after < 0.5


def test_damaged_head_loses_no_message_and_says_so(path, tmp_path):
    data = bytearray(path.read_bytes())
    data[data.index(b"scene.yaml") + 40] ^= 4
    saved = recover(damaged(tmp_path, bytes(data)))
    count = sum(read_run(path).topics.values())
    assert sum(saved.messages.values()) == count
    assert any(f"no message was in them: all {count} are saved" in line for line in saved.losses)
    assert "attachment scene.yaml; the announced run holds the scene too" in saved.losses
    assert not any("metadata capture_sim" in line for line in saved.losses)
    again = read_run(saved.path)
    assert again.scene == read_run(path).scene
    assert again.metadata["run_id"] == read_run(path).metadata["run_id"]
