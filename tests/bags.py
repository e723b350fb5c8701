"""Bare MCAP files as other recorders leave them: no scene, and the wall's clock."""

from __future__ import annotations

import struct

import yaml
from mcap.reader import make_reader
from mcap.writer import Writer

WALL = 1_790_000_000  # s, of a wall clock
#: What any bench publishes.
STANDARD = ("/chaser/odom", "/target/odom", "/joint_states", "/contact/wrench")


def unchanged(topic, data):
    yield topic, "cdr", data


def copied(source, path, *, topics=None, late=0, change=unchanged, **how):
    """Copy a recording's messages, logged ``late`` s later; ``how`` is the writer's.

    ``change(topic, data)`` gives topic, encoding and bytes of each that is written for one.
    """
    with source.open("rb") as read, path.open("wb") as write:
        writer = Writer(write, **how)
        writer.start(profile="ros2", library="another recorder")
        channels = {}
        for schema, channel, message in make_reader(read).iter_messages(topics=topics):
            time = message.log_time + late * 10**9
            for topic, encoding, data in change(channel.topic, message.data):
                if (topic, encoding) not in channels:
                    cdr = (schema.encoding, schema.data)
                    kept = cdr if encoding == "cdr" else ("jsonschema", b"{}")
                    known = writer.register_schema(schema.name, *kept)
                    channels[topic, encoding] = writer.register_channel(topic, encoding, known)
                writer.add_message(channels[topic, encoding], time, data, time)
        writer.finish()
    return path


def later(topic, data):
    """Add WALL to a message's stamp, which follows the four bytes that tell the byte order."""
    (seconds,) = struct.unpack_from("<i", data, 4)
    yield topic, "cdr", data[:4] + struct.pack("<i", seconds + WALL) + data[8:]


def of_a_bench(source, path, topics=STANDARD):
    """Copy some topics, late by WALL, by their stamps as well."""
    return copied(source, path, topics=topics, late=WALL, change=later)


def in_two_files(source, folder, at):
    """Copy a recording into a bag's folder of two files, as rosbag2 splits it at a log time, s."""
    folder.mkdir()
    names = [f"{folder.name}_{part}.mcap" for part in range(2)]
    with source.open("rb") as read:
        stored = [(c.topic, s, c, m) for s, c, m in make_reader(read).iter_messages()]
    for name, early in zip(names, (True, False), strict=True):
        with (folder / name).open("wb") as write:
            writer = Writer(write, chunk_size=100_000)
            writer.start(profile="ros2")
            ids = {}
            for topic, schema, channel, message in stored:
                if (message.log_time < at * 1e9) is early:
                    if topic not in ids:
                        kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                        ids[topic] = writer.register_channel(topic, "cdr", kind, channel.metadata)
                    writer.add_message(ids[topic], message.log_time, message.data, message.log_time)
            writer.finish()
    listed = {"rosbag2_bagfile_information": {"relative_file_paths": names}}
    (folder / "metadata.yaml").write_text(yaml.safe_dump(listed))
    return folder
