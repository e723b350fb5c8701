"""Whatever a recording lacks, it is read, or refused in one line that names what is missing.

Each part of a small recording is taken away: every field of every message type, every message,
topic, definition, entry of metadata, and the attachment; alone, and random pairs of them.
"""

from __future__ import annotations

import itertools
import random
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
from cases import cases
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import capture_sim
from capture_sim.cli import main
from capture_sim.errors import CaptureSimError
from capture_sim.messages.evolution import defaults
from capture_sim.messages.topics import topic_named
from capture_sim.recording.offline import write_run
from capture_sim.recording.playback import Playback
from capture_sim.recording.read import read_run
from capture_sim.run.run import detect
from capture_sim.viewing.curves import plotted_runs
from capture_sim.viewing.figures import pictures_of

#: Random pairs of missing parts.
PAIRS = cases(few=10, all=60)
#: Of the parts that are missing alone, one of so many is tried.
STEP = cases(few=7, all=1)
#: What a rig publishes, and what the suite's nodes send beside it.
OF_A_RIG = {
    *("/chaser/odom", "/target/odom", "/joint_states", "/contact/wrench", "/bench/contact"),
    *(
        "/bench/buffer",
        "/bench/run_info",
        "/bench/stream_counts",
        "/launcher/command",
        "/launcher/state",
    ),
    *("/capture/status", "/capture/verdict", "/capture/criteria", "/launcher/phase"),
}
#: Types that the library has itself: it reads no definition that differs.
BUILT_IN = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
LINE = "=" * 80 + "\n"


class Part(NamedTuple):
    """A part of a recording: its kind, and the names that find it."""

    kind: str
    name: str
    of: str = ""
    section: str = ""


class Recording:
    """A recording as parts, which can be written again without some of them."""

    def __init__(self, path: Path, topics: set[str] | None = None) -> None:
        with path.open("rb") as file:
            reader = make_reader(file)
            stored = list(reader.iter_messages(topics=topics))
            self.metadata = {
                record.name: dict(record.metadata) for record in reader.iter_metadata()
            }
            self.attachments = {each.name: each.data for each in reader.iter_attachments()}
        self.messages = [(c.topic, s.name, m.data, m.log_time) for s, c, m in stored]
        self.types = {channel.topic: schema.name for schema, channel, _ in stored}
        self.schemas = {schema.name: schema.data.decode() for schema, _, _ in stored}

    def parts(self) -> list[Part]:
        """Return all parts."""
        found = [Part("topic", topic) for topic in self.types]
        found += [Part("message", str(i)) for i in range(len(self.messages))]
        found += [Part("definition", name) for name in self.schemas]
        found += [Part("attachment", name) for name in self.attachments]
        for record, entries in self.metadata.items():
            found += [Part("record", record), *(Part("entry", key, record) for key in entries)]
        for name, text in self.schemas.items():
            for section, lines in sections(name, text):
                fields = [field for line in lines if (field := field_of(line))]
                # ROS has no message without a field
                found += [Part("field", f, name, section) for f in fields if len(fields) > 1]
        return found

    def without(self, path: Path, *missing: Part) -> Path:
        """Write the recording without some parts."""
        kinds = set(missing)
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start(profile="ros2", library="a test")
            for record, entries in self.metadata.items():
                if Part("record", record) not in kinds:
                    kept = {
                        k: v for k, v in entries.items() if Part("entry", k, record) not in kinds
                    }
                    writer.add_metadata(record, kept)
            for name, data in self.attachments.items():
                if Part("attachment", name) not in kinds:
                    writer.add_attachment(0, 0, name, "application/yaml", data)
            channels = {}
            for i, (topic, name, data, time) in enumerate(self.messages):
                if Part("topic", topic) in kinds or Part("message", str(i)) in kinds:
                    continue
                cut = frozenset((p.section, p.name) for p in missing if p[::2] == ("field", name))
                if topic not in channels:
                    text = shortened(name, self.schemas[name], cut)
                    if Part("definition", name) in kinds:
                        text = ""
                    schema = writer.register_schema(name, "ros2msg", text.encode())
                    channels[topic] = writer.register_channel(topic, "cdr", schema)
                cut = frozenset(field for field in cut if field[0] not in BUILT_IN)
                data = rewritten(name, self.schemas[name], cut, data) if cut else data
                writer.add_message(channels[topic], time, data, time)
            writer.finish()
        return path


def sections(name, text):
    """Yield the types that a definition contains, with their lines."""
    own, *others = text.split(LINE)
    yield name, own.splitlines()
    for other in others:
        head, *lines = other.splitlines()
        package, _, kind = head.removeprefix("MSG: ").partition("/")
        yield f"{package}/msg/{kind.removeprefix('msg/')}", lines


def field_of(line):
    """Return the name of the field that a line declares; None for any other line."""
    words = line.split("#")[0].split()
    return words[1] if len(words) > 1 and "=" not in line.split("#")[0] else None


@cache
def shortened(name, text, cut):
    """Return a definition without some fields, as (type, field)."""
    parts = []
    for section, lines in sections(name, text):
        kept = [line for line in lines if (section, field_of(line)) not in cut]
        head = [] if section == name else [f"MSG: {section.replace('/msg/', '/')}"]
        parts.append("\n".join([*head, *kept]) + "\n")
    return LINE.join(parts)


@cache
def store_of(name, text):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, name))
    return store


@cache
def rewritten(name, text, cut, data):
    """Return a serialised message without the fields of its type that are cut."""
    whole, short = store_of(name, text), store_of(name, shortened(name, text, cut))

    def converted(value, kind):
        def of(described, item):
            if described[0] is Nodetype.NAME:
                return converted(item, described[1])
            if described[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) and isinstance(item, list):
                return [of(described[1][0], each) for each in item]
            return item

        fields = {f: of(d, getattr(value, f)) for f, d in short.fielddefs[kind][1]}
        return short.types[kind](**fields)

    message = converted(whole.deserialize_cdr(data, name), name)
    return bytes(short.serialize_cdr(message, name))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run with touches, whose recording has some hundred messages."""
    changes = {"run.t_end": 0.12, "run.state_rate": 100, "run.rate": 50}
    result = capture_sim.simulate(capture_sim.load_scene("paper_designed", changes))
    return write_run(result, tmp_path_factory.mktemp("runs") / "run.mcap", run_id="a run")


@pytest.fixture(scope="module", params=["simulated", "rig", "rig without a scene"])
def recording(request, made):
    found = Recording(made, None if request.param == "simulated" else OF_A_RIG)
    if request.param == "rig without a scene":
        found.attachments, found.metadata = {}, {}
        info = ("/bench/run_info", "/bench/stream_counts")
        found.messages = [row for row in found.messages if row[0] not in info]
        found.types = {t: name for t, name in found.types.items() if t not in info}
    return found


#: Geometry of a run that is recorded without one.
SCENE = capture_sim.load_scene("paper_designed")
#: What each command asks of a recording; all raise CaptureSimError where they refuse it.
CORES = {
    "detect": lambda run: detect(run),
    "table": lambda run: run.summary,
    "view": lambda run: (plotted_runs([run], ["a"]), pictures_of([run], ["a"], None)),
    "report": lambda run: (run.made_by, run.verdict, run.events, repr(run)),
    "export": lambda run: [run.tables[topic].fields for topic in run.tables],
    "compare": lambda run: (run.first_contact, run.resolved_touches, run.cone_force),
    "calibrate": lambda run: (run.plan, *map(run.measured, ("chaser", "target", "stroke"))),
}


def refusals(path: Path) -> dict[str, str]:
    """Let every command's core read a file; return the lines of those that refuse it."""
    found = {}

    def tried(command, action):
        try:
            return action()
        except CaptureSimError as error:
            line = str(error)
            assert line.isprintable(), (command, line)
            assert len(line) < 400, (command, line)
            found[command] = line
            return None

    run = tried("read", lambda: read_run(path))
    if run is not None and run.given.scene is None:
        run = read_run(path, scene=SCENE)
    if run is not None:
        for command, core in CORES.items():
            tried(command, lambda core=core: core(run))
    tried("replay", lambda: list(Playback(path).messages()))
    return found


def test_each_part_alone(recording, tmp_path):
    """A refusal names the file, and of a missing field its topic and the field."""
    refused = 0
    assert not refusals(recording.without(tmp_path / "whole.mcap"))
    parts = recording.parts()
    assert len(parts) > 150
    if not recording.metadata:
        parts = [part for part in parts if part.kind != "message"]  # as of the rig with a scene
    few = [part for part in parts if part.kind in ("attachment", "record")]
    for part in [*few, *parts[::STEP]]:
        path = recording.without(tmp_path / "less.mcap", part)
        for command, line in refusals(path).items():
            refused += 1
            where = (part, command, line)
            assert str(path) in line, where
            if part.kind == "field" and part.section in BUILT_IN:
                assert part.section in line, where
            elif part.kind == "field":
                assert part.name in line, where
                topics = [topic for topic, name in recording.types.items() if name == part.of]
                assert any(topic.strip("/") in line for topic in topics), where
                # those that came later have a default
                assert not (part.section == part.of and part.name in own_defaults(part.of)), where
    assert refused


def own_defaults(type_name):
    return defaults(type_name) if type_name.startswith("capture_sim/") else {}


def test_pairs_of_parts(recording, tmp_path):
    rng = random.Random(5)
    parts = recording.parts()
    for _ in range(PAIRS):
        pair = rng.sample(parts, 2)
        for line in refusals(recording.without(tmp_path / "less.mcap", *pair)).values():
            assert str(tmp_path / "less.mcap") in line, (pair, line)


@pytest.mark.parametrize("recording", ["rig"], indirect=True)
@pytest.mark.parametrize("command", ["detect", "export", "compare", "report", "view", "calibrate"])
def test_whole_commands_end_in_one_line(recording, command, tmp_path, capsys, monkeypatch):
    """A field that each of them needs, and one of every kind of part."""
    monkeypatch.chdir(tmp_path)
    parts = recording.parts()
    needed = [p for p in parts if p.kind == "field" and p.name in ("pose", "q", "x", "state")]
    kinds = [next(group) for _, group in itertools.groupby(parts, key=lambda part: part.kind)]
    for part in random.Random(command).sample([*needed, *kinds], 2):
        path = recording.without(tmp_path / "less.mcap", part)
        arguments = [str(path), *([str(path)] if command == "compare" else [])]
        arguments += ["--fit=mu", "--restarts=0"] if command == "calibrate" else []
        status = main([command, *arguments, "--scene=paper_designed"])
        lines = capsys.readouterr().err.splitlines()
        assert status in (0, 1, 2), (part, lines)
        assert not any("Error:" in line for line in lines), (part, lines)


def test_topics_of_the_bench_are_known():
    assert all(topic_named(name) is not None for name in OF_A_RIG)
