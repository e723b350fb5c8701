"""Files that unpack to more than a machine has, and definitions that no parser ends with."""

import sqlite3
import time
import tracemalloc

import dirty
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from capture_sim.cli import main
from capture_sim.recording.bag import read_bag
from capture_sim.recording.read import run_of
from capture_sim.recording.records import MEMORY_LIMIT
from capture_sim.run.run import detect
from capture_sim.scene.loading import load_scene

SEPARATOR = "=" * 80
#: Definitions by name: encoding and text.
DEFINITIONS = {
    "infinite constant": ("ros2msg", "float64 HUGE=1e999\nfloat64 x"),
    "name with a digit": ("ros2msg", f"float64 x\n{SEPARATOR}\nMSG: 1a/B\nfloat64 y"),
    "array of texts": ("ros2msg", "string[200000000] a"),
    "brackets": (
        "ros2idl",
        f"module p {{ module msg {{ const long X = {'(' * 8}1{')' * 8}; }}; }};",
    ),
    "shift": ("ros2idl", "module p { module msg { const long X = 1 << 99999999999; }; };"),
    "many fields": ("ros2msg", "\n".join(f"float64 x{i}" for i in range(200_000))),
    "itself": ("ros2msg", "p/T a"),
    "another type": ("ros2idl", "module q { module msg { struct Z { long x; }; }; };"),
}


def with_topics(path, definitions, *, messages=20, size=64, compression=CompressionType.ZSTD):
    """Write a whole trial, beside topics with these definitions, by name of the topic."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start("ros2")
        ids = {}
        for name, (encoding, text) in definitions.items():
            schema = writer.register_schema(
                "p/msg/T" if "/" in name[1:] else "p/msg/U", encoding, text
            )
            ids[name] = writer.register_channel(name, "cdr", schema)
        for record in dirty.clean():
            if record.topic not in ids:
                text = dirty._definition(record.type_name).encode()
                schema = writer.register_schema(record.type_name, "ros2msg", text)
                ids[record.topic] = writer.register_channel(record.topic, "cdr", schema)
            writer.add_message(ids[record.topic], record.log_time, record.data, record.log_time)
        for name in definitions:
            for k in range(messages):
                t = record.log_time - k
                writer.add_message(ids[name], t, b"\0\1\0\0" + bytes(size), t)
        writer.finish()
    return path


@pytest.mark.parametrize("name", DEFINITIONS)
def test_a_bad_definition_costs_its_topic_at_most(name, tmp_path, capsys):
    encoding, text = DEFINITIONS[name]
    path = with_topics(tmp_path / "a.mcap", {"/other": (encoding, text.encode())})
    for command in ("detect", "inspect"):
        assert main([command, str(path), "--scene", "tilt_p10"]) == 0, capsys.readouterr().err
    assert main(["export", str(path), "--out", str(tmp_path / "tables")]) == 0
    error = capsys.readouterr().err
    assert "/other is left out" in error
    assert "internal" not in error


def test_many_topics_end(tmp_path):
    path = with_topics(
        tmp_path / "a.mcap", {f"/t{k}": ("ros2msg", b"float64 x") for k in range(3000)}, messages=1
    )
    begin = time.process_time()
    assert len(read_bag(path).topics) == 3004
    assert time.process_time() - begin < 60.0


def test_cameras_need_no_memory(tmp_path):
    """Images are unpacked chunk by chunk, and kept only if they are asked for."""
    camera = {"/camera/image": ("ros2msg", b"uint8[] data")}
    plain = CompressionType.NONE  # zeros would be too good to be true
    path = with_topics(tmp_path / "a.mcap", camera, messages=100, size=2_000_000, compression=plain)
    tracemalloc.start()
    bag = read_bag(path)
    verdict = detect(run_of(bag, load_scene("tilt_p10")))[-1]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert verdict.label == dirty.TRUE.verdict
    assert peak < 60e6  # of 200 MB
    assert bag.topics["/camera/image"] == 100
    images = bag.raw("/camera/image")
    assert (len(images), len(images[0])) == (100, 2_000_004)


def test_more_than_the_memory_is_one_line_and_an_option_raises_it(tmp_path, capsys):
    path = dirty.write(tmp_path, "plain")
    arguments = ["detect", str(path), "--scene", "tilt_p10"]
    assert main([*arguments, "--memory", "0.001"]) == 1
    error = capsys.readouterr().err
    assert "more than 0.001 GiB of memory: --memory raises this limit" in error
    assert error.count("\n") == 1
    assert main(arguments) == 0
    assert MEMORY_LIMIT.get() == 2**30  # of each command
    assert main([*arguments, "--memory", "nothing"]) == 2
    assert "must be 0.001 to 1e6 GiB" in capsys.readouterr().err


def test_the_limit_is_of_the_whole_bag(tmp_path, capsys):
    """Many parts, each within the limit of a file."""
    folder = tmp_path / "bag"
    folder.mkdir()
    for k in range(6):
        later = [r._replace(log_time=r.log_time + k * 10**10) for r in dirty.clean()]
        dirty.write_mcap(folder / f"part_{k}.mcap", later)
    assert main(["detect", str(folder), "--scene", "tilt_p10", "--memory", "0.003"]) == 1
    error = capsys.readouterr().err
    assert error.count("memory") >= 1
    assert "Traceback" not in error


@pytest.mark.parametrize("kind", ["generated column", "view"])
def test_tables_that_sqlite_computes_are_refused(kind, tmp_path, capsys):
    path = tmp_path / "a.db3"
    columns = "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB"
    with sqlite3.connect(path) as bag:
        bag.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
            " serialization_format TEXT, offered_qos_profiles TEXT)"
        )
        if kind == "view":
            bag.execute(f"CREATE TABLE stored({columns})")
            bag.execute("CREATE VIEW messages AS SELECT *, zeroblob(100000000) AS more FROM stored")
        else:
            bag.execute(
                "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER,"
                " timestamp INTEGER, data BLOB GENERATED ALWAYS AS (zeroblob(100000000)) VIRTUAL)"
            )
    begin = time.process_time()
    assert main(["detect", str(path), "--scene", "tilt_0"]) == 2
    assert time.process_time() - begin < 10.0
    assert "must be a table without computed columns" in capsys.readouterr().err


def test_a_compressed_file_of_zeros_is_refused(tmp_path, capsys):
    path = tmp_path / "a.mcap.zst"
    path.write_bytes(zstandard.compress(bytes(500_000_000)))
    assert main(["detect", str(path), "--scene", "tilt_0"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
