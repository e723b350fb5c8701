"""Recordings as laboratories make them (tests/dirty.py): what is read of each, and what is said."""

from __future__ import annotations

import gzip
import hashlib
import struct
from functools import partial

import dirty
import lz4.frame
import numpy as np
import pytest
import zstandard
from rosbags.rosbag2 import Reader

import capture_sim
from capture_sim.cli import main
from capture_sim.errors import CaptureSimError, RecordingError
from capture_sim.messages.topics import JOINT_STATES
from capture_sim.recording.bag import read_bag
from capture_sim.recording.bag_folder import bag_files, sha256_of
from capture_sim.recording.playback import Playback
from capture_sim.recording.read import read_run
from capture_sim.run.run import detect

#: Files whose contents are those of the clean one.
INTACT = (
    *("no_definitions", "compressed_messages", "compressed_file", "lz4_chunks", "sqlite"),
    *("sqlite_compressed_messages", "sqlite_compressed_file", "lone_zstd", "lone_zstd_long_name"),
    *("last_part_empty", "last_part_unlisted", "file_twice", "metadata_cut"),
    "no_metadata_compressed_messages",
)
#: Of those, the ones that rosbags' reader reads.
OF_ROSBAGS = ("compressed_messages", "compressed_file", "sqlite", "sqlite_compressed_messages")


@pytest.fixture(scope="module")
def scene():
    return capture_sim.load_scene("tilt_p10")


def messages_of(bag):
    return {name: (bag.raw(name), bag.log_times(name).tolist()) for name in sorted(bag.topics)}


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return read_bag(dirty.write(tmp_path_factory.mktemp("clean"), "plain"))


def test_clean_recording_is_read_complete_and_captured(clean, scene):
    assert sum(clean.topics.values()) == len(dirty.clean())
    assert clean.problems == clean.left_out == ()
    verdict = detect(read_run(clean.path), scene)[-1]
    assert verdict.label == dirty.TRUE.verdict


@pytest.mark.parametrize("kind", INTACT)
def test_file_of_every_kind_gives_the_same_messages(kind, clean, tmp_path):
    bag = read_bag(dirty.write(tmp_path, kind))
    assert messages_of(bag) == messages_of(clean)
    for topic in (dirty.CHASER, dirty.JOINTS):
        fields = bag.columns(topic)
        assert fields.keys() == clean.columns(topic).keys()
        assert fields["header.stamp.nanosec"].tolist() == [
            r.stamp % 10**9 for r in dirty.clean() if r.topic == topic
        ]


@pytest.mark.parametrize("kind", OF_ROSBAGS)
def test_bag_holds_the_messages_that_rosbags_reads(kind, tmp_path):
    path = dirty.write(tmp_path, kind)
    bag = read_bag(path)
    with Reader(path) as reader:
        read = list(reader.messages())
    for name in bag.topics:
        expected = [(bytes(data), time) for c, time, data in read if c.topic == name]
        assert list(zip(bag.raw(name), bag.log_times(name).tolist(), strict=True)) == expected


@pytest.mark.parametrize("kind", ["sqlite", "file_twice", "lone_zstd"])
def test_the_hash_of_a_recording_is_that_of_the_files_that_are_read(kind, tmp_path):
    """That of a .db3 file's folder was the hash of nothing."""
    path = dirty.write(tmp_path, kind)
    files = bag_files(path).files
    assert all(file.stat().st_size for file in files)
    whole = b"".join(file.read_bytes() for file in files)
    assert sha256_of(path) == hashlib.sha256(whole).hexdigest()


@pytest.mark.parametrize("kind", ["compressed_messages", "sqlite_compressed_file", "lone_zstd"])
def test_commands_and_replay_use_unpacked_messages(kind, clean, tmp_path, capsys):
    path = dirty.write(tmp_path, kind)
    assert main(["detect", str(path), "--scene", "tilt_p10"]) == 0
    printed = capsys.readouterr()
    assert "verdict: captured" in printed.out
    assert printed.err == ""
    played = Playback(path)
    assert [data for _, _, data in played.messages()] == [
        data for _, _, data in Playback(clean.path).messages()
    ]


@pytest.mark.parametrize(
    "kind, line",
    [
        ("last_part_empty", "part_3.mcap: not an MCAP file: it is empty"),
        ("last_part_unlisted", "part_2.mcap: not listed in metadata.yaml; read as the next part"),
        ("file_twice", "part_0 (copy).mcap: left out: a copy of part_0.mcap"),
        ("metadata_cut", "metadata.yaml: left out: not the metadata of a bag; the files are read "),
        ("one_log_time_wrapped", "joint_states: left out: 1 of 622 messages: log time 18446744"),
        ("first_logged_at_zero", "60 messages without a log time (0 ns)"),
        ("log_times_jump", "the log times jump by +1095 days after 4038 messages; they are cou"),
        ("recorder_killed", "read up to byte 496800 of 496800 (incomplete record): 4160 messages"),
        ("json", "/joint_states: left out: messages are encoded as 'json', must be cdr"),
    ],
)
def test_what_is_odd_is_one_line(kind, line, tmp_path):
    bag = read_bag(dirty.write(tmp_path, kind))
    lines = [*bag.left_out, *bag.problems]
    assert any(line in each for each in lines), lines
    assert len(lines) == (4 if kind == "json" else 1)


def test_part_that_is_not_listed_and_does_not_follow_is_named_and_not_read(clean, tmp_path):
    path = dirty.write(tmp_path, "last_part_unlisted")
    (path / "part_2.mcap").rename(path / "yesterday.mcap")
    bag = read_bag(path)
    assert bag.left_out == ("yesterday.mcap: left out: not listed in metadata.yaml",)
    assert sum(bag.topics.values()) < sum(clean.topics.values())


def test_listed_part_that_is_missing_hides_no_other(tmp_path):
    path = dirty.write(tmp_path, "last_part_unlisted")
    (path / "part_0.mcap").unlink()
    bag = read_bag(path)
    assert bag.problems == ("part_0.mcap: cannot read: No such file or directory",)
    assert sum(bag.topics.values()) > 1000


@pytest.mark.parametrize("kind", ["first_logged_at_zero", "log_times_jump"])
def test_replay_waits_for_no_clock_that_was_set(kind, tmp_path):
    """It takes the run's 6.2 s, and plays all messages in the order of the file."""
    played = Playback(dirty.write(tmp_path, kind))
    assert (played.end - played.start) / 1e9 == pytest.approx(6.2, abs=0.2)
    assert played.doubts
    messages = [data for _, topic, data in played.messages() if topic == dirty.CHASER]
    assert messages == [r.data for r in dirty.clean() if r.topic == dirty.CHASER]


def test_log_times_that_step_back_by_years_keep_the_order_of_the_file(clean, tmp_path):
    years = 3 * 365 * 86_400 * 10**9
    records = [
        r if i < 4000 else r._replace(log_time=r.log_time - years)
        for i, r in enumerate(dirty.clean())
    ]
    bag = read_bag(dirty.write_mcap(tmp_path / "back.mcap", records))
    for name in bag.topics:
        assert bag.raw(name) == clean.raw(name)
        assert (np.diff(bag.log_times(name)) >= 0).all()
    assert bag.left_out == (
        "the log times jump by -1095 days after 4000 messages; they are counted on from there",
    )


def test_messages_that_are_not_in_the_sqlite_file_yet_are_named(clean, tmp_path):
    """A killed recorder leaves them in a file beside it, which was ignored in silence."""
    path = dirty.write(tmp_path, "sqlite") / "sqlite.db3"
    path.with_name("sqlite.db3-wal").write_bytes(bytes(4096))
    bag = read_bag(path)
    assert any("sqlite.db3-wal beside it has messages" in line for line in bag.problems)
    assert sum(bag.topics.values()) == sum(clean.topics.values())


@pytest.mark.parametrize("name", ["a #1?.db3", "100%.db3"])
def test_sqlite_file_of_any_name_is_read(name, clean, tmp_path):
    path = dirty.write(tmp_path, "sqlite") / "sqlite.db3"
    path = path.rename(tmp_path / name)
    assert messages_of(read_bag(path)) == messages_of(clean)


@pytest.mark.parametrize(
    "data, line",
    [
        (b"#ROSBAG V2.0\n" + b"x" * 100, "a bag of ROS 1; convert it: rosbags-convert --src"),
        (gzip.compress(b"x" * 100), "compressed by gzip; unpack it: gunzip -k"),
        (b"SQLite format 3\x00" + bytes(200), "not a bag of rosbag2"),
        (b"\x28\xb5\x2f\xfd" + b"0" * 40, "damaged compression"),
        (b"\x04\x22\x4d\x18" + bytes(40), "damaged compression"),
        (b"", "it is empty"),
    ],
    ids=["ROS 1", "gzip", "sqlite", "zstd", "lz4", "empty"],
)
def test_file_of_another_kind_is_named_with_what_converts_it(data, line, tmp_path, capsys):
    file = tmp_path / "run.mcap"
    file.write_bytes(data)
    with pytest.raises(RecordingError, match=r"run\.mcap: ") as caught:
        read_bag(file)
    assert line in str(caught.value)
    assert main(["detect", str(file)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("rest", [None, b"", b"\x20"], ids=["content", "no head", "half a head"])
def test_compressed_message_that_is_damaged_is_left_out_and_counted(rest, clean, tmp_path):
    records = list(dirty.clean())
    rest = records[5].data if rest is None else rest
    records[5] = records[5]._replace(data=b"\x28\xb5\x2f\xfd" + rest)
    bag = read_bag(dirty.write_mcap(tmp_path / "x.mcap", records))
    assert sum(bag.topics.values()) == len(records) - 1
    (line,) = bag.left_out
    assert line.endswith("messages: damaged compression")


@pytest.mark.parametrize("compress", [zstandard.compress, lz4.frame.compress], ids=["zstd", "lz4"])
def test_message_in_two_joined_frames_is_read_whole(compress, clean, tmp_path):
    records = list(dirty.clean())
    data = records[5].data
    joined = compress(data[:40]) + compress(data[40:])
    read = [*records[:5], records[5]._replace(data=joined), *records[6:]]
    bag, plain = (
        read_bag(dirty.write_mcap(tmp_path / name, each))
        for name, each in (("joined.mcap", read), ("plain.mcap", records))
    )
    topic = records[5].topic
    assert list(bag.raw(topic)) == list(plain.raw(topic))
    assert not bag.left_out


# joints


@pytest.mark.parametrize("apart", [0, 1_000_000])
def test_joints_in_messages_of_their_own_are_joined_by_their_stamps(apart, clean, scene, tmp_path):
    records = dirty.one_joint_a_message(dirty.clean(), apart)
    path = dirty.write_mcap(tmp_path / "x.mcap", records)
    stamps, values, _ = read_bag(path).measured(JOINT_STATES)
    all_stamps, all_values, _ = clean.measured(JOINT_STATES)
    if not apart:
        assert stamps.tolist() == all_stamps.tolist()
        assert values.tolist() == all_values.tolist()
    for column, late in ((0, apart), (1, 0)):  # the hinge comes first
        times, at = all_stamps - all_stamps[0], stamps - late - all_stamps[0]
        truth = np.interp(at, times, all_values[:, column])
        assert values[:, column] == pytest.approx(truth, abs=1e-12)
    verdict = detect(read_run(path, scene=scene))[-1]
    # no buffer is known at the first pose if the slide's first stamp is later
    assert verdict.not_used == ("" if not apart else "buffer: 1 gap of 1242")
    assert verdict.label == dirty.TRUE.verdict


def test_joints_with_a_prefix_are_the_buffers(clean, tmp_path):
    bag = read_bag(dirty.write(tmp_path, "joints_prefixed"))
    assert bag.measured(JOINT_STATES)[1].tolist() == clean.measured(JOINT_STATES)[1].tolist()


NEEDED = "must be buffer_slide and buffer_hinge"


def other(message, _):
    message.name = ["gripper", "wrist"]


def of_two(message, _):
    message.name = ["left/buffer_slide", "right/buffer_slide"]


def one_only(message, _):
    message.name, message.position, message.velocity = message.name[:1], np.zeros(1), np.zeros(0)


@pytest.mark.parametrize(
    "change, why",
    [
        (dirty._no_names, f"no joint names: {NEEDED}"),
        (dirty._no_positions, "0 positions of 2 joints: must be one of each"),
        (other, f"joints gripper, wrist: {NEEDED}"),
        (of_two, "buffers with the prefixes left/, right/: must be one buffer"),
        (one_only, f"only buffer_hinge: {NEEDED}"),
    ],
    ids=["no names", "no positions", "other", "two", "one"],
)
def test_joints_that_are_not_the_buffers_are_refused_by_name(change, why, scene, tmp_path):
    path = dirty.write_mcap(tmp_path / "x.mcap", dirty.changed(dirty.clean(), dirty.JOINTS, change))
    assert read_bag(path).unused(JOINT_STATES) == f"622 of 622 messages: {why}"
    with pytest.raises(RecordingError, match="joint_states: 622 of 622 messages") as caught:
        detect(read_run(path, scene=scene))
    assert why in str(caught.value)
    for look in ("samples", "summary"):
        with pytest.raises(RecordingError, match="buffer_hinge"):
            getattr(read_run(path, scene=scene), look)


def test_a_damaged_message_does_not_hide_that_the_joints_are_others(tmp_path):
    records = list(dirty.changed(dirty.clean(), dirty.JOINTS, other))
    first = next(i for i, record in enumerate(records) if record.topic == dirty.JOINTS)
    records[first] = records[first]._replace(data=records[first].data[:20])
    bag = read_bag(dirty.write_mcap(tmp_path / "x.mcap", records))
    reasons = bag.unused(JOINT_STATES).split("; ")
    assert reasons[0] == f"621 of 622 messages: joints gripper, wrist: {NEEDED}"
    assert reasons[1:] == ["1 of 622 messages: cannot be decoded"]


def test_joints_that_are_no_numbers_are_counted(tmp_path):
    bag = read_bag(dirty.write(tmp_path, "joints_nan"))
    assert bag.unused(JOINT_STATES) == "622 of 622 messages: not finite"


# whatever a file holds


def damaged(data, rng):
    """Return bytes with a few of them changed, cut or repeated."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        place = int(rng.integers(0, len(data)))
        kind = rng.integers(0, 4)
        if kind == 0:
            data[place] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            data[place : place + 8] = rng.bytes(8)
        elif kind == 2:
            data[place : place + 8] = struct.pack("<Q", 2**64 - 1)
        else:
            del data[place : place + int(rng.integers(1, 2000))]
        if len(data) < 2:
            break
    return bytes(data)


#: Kinds of files whose bytes are damaged.
DAMAGED = (
    *("plain", "lz4_chunks", "compressed_messages", "compressed_file", "sqlite", "lone_zstd"),
    *("sqlite_compressed_messages", "recorder_killed", "no_definitions"),
)


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_bytes_give_a_run_or_one_line(kind, scene, tmp_path):
    """Of a short recording, so that a chance byte meets each kind of record."""
    path = dirty.write(tmp_path, kind, dirty.clean()[:300])
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    whole = {file: file.read_bytes() for file in files}
    rng = np.random.default_rng(DAMAGED.index(kind))
    for _ in range(15):
        file = files[int(rng.integers(0, len(files)))]
        file.write_bytes(damaged(whole[file], rng))
        try:
            run = read_run(path, scene=scene)
            lines = (*run.origin.left_out, *run.problems)
            looks = (partial(detect, run), lambda run=run: run.samples, lambda run=run: run.summary)
            for look in looks:
                try:
                    look()
                except CaptureSimError as error:
                    lines += (str(error),)
        except CaptureSimError as error:
            lines = (str(error),)
        assert all(line.isprintable() for line in lines), lines
        file.write_bytes(whole[file])
