"""Bare MCAP files as other recorders leave them: no scene, and the wall's clock."""

from __future__ import annotations

import struct

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
