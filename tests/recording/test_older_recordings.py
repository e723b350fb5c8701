"""Recordings from before some fields were added to their messages."""

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import capture_sim
from capture_sim.cli import main
from capture_sim.errors import RecordingError
from capture_sim.messages.definitions import typestore
from capture_sim.recording.bag import read_bag
from capture_sim.recording.export import readable
from capture_sim.recording.offline import write_run
from capture_sim.recording.read import read_run

#: Fields that the first recordings lack.
LATER = {
    "capture_sim/msg/BenchState": ("dissipated_slide",),
    "capture_sim/msg/CaptureStatus": ("chaser_rejected", "target_rejected", "buffer_rejected"),
}


def without(definition, names):
    """Return a message definition without some fields."""
    own, *parts = definition.split("=" * 80 + "\n")
    kept = [line for line in own.splitlines() if line.split("#")[0].split()[1:2] not in names]
    return ("=" * 80 + "\n").join(["\n".join(kept) + "\n", *parts])


class Older:
    """The messages of one type as they were before."""

    def __init__(self, name, definition, fields):
        self.name, self.text = name, without(definition, [[field] for field in fields])
        self._store = get_typestore(Stores.EMPTY)
        self._store.register(get_types_from_msg(self.text, name))
        self._newer = typestore()

    def rewritten(self, data):
        message, kind = self._newer.deserialize_cdr(data, self.name), self._store.types[self.name]
        names = [name for name in kind.__dataclass_fields__ if name != "__msgtype__"]
        values = {name: getattr(message, name) for name in names}
        return bytes(self._store.serialize_cdr(kind(**values), self.name))


def made_older(source, path, later=LATER):
    """Copy a recording, without some fields by type."""
    older, channels = {}, {}
    with source.open("rb") as read, path.open("wb") as write:
        reader, writer = make_reader(read), Writer(write)
        writer.start()
        for schema, channel, message in reader.iter_messages():
            data, text = message.data, schema.data.decode()
            if schema.name in later:
                if schema.name not in older:
                    older[schema.name] = Older(schema.name, text, later[schema.name])
                data, text = older[schema.name].rewritten(data), older[schema.name].text
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, text.encode())
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, number, channel.metadata
                )
            number = channels[channel.topic]
            writer.add_message(number, message.log_time, data, message.publish_time)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()
    assert set(older) == set(later)
    return path


def test_a_recording_without_later_fields_is_read(tmp_path, capsys):
    """Friction of the slide is then 0; counts of rejected measurements are not reported."""
    result = capture_sim.simulate(capture_sim.load_scene("tilt_0"))
    path = write_run(result, tmp_path / "new.mcap")
    old = made_older(path, tmp_path / "old.mcap")
    expected, found = read_run(path), read_run(old)
    assert "dissipated_slide" not in read_bag(old).columns("/bench/state")
    assert np.all(found.samples["dissipated_slide"] == 0.0)
    for name in ("t", "q", "v", "normal_force", "energy_residual"):
        assert np.array_equal(found.samples[name], expected.samples[name])
    assert found.loads == expected.loads
    assert [status.state for status in found.statuses] == [x.state for x in expected.statuses]
    for command in (["detect", str(old)], ["compare", str(old), str(path)]):
        assert main([*command]) == 0, capsys.readouterr()


def test_a_trace_that_lacks_a_field_is_one_error_and_the_other_tables_are_read(tmp_path):
    result = capture_sim.simulate("tilt_0", {"run.trace": True})
    path = write_run(result, tmp_path / "new.mcap")
    lacking = {"capture_sim/msg/ContactTrace": ("dissipated_friction",)}
    run = read_run(made_older(path, tmp_path / "old.mcap", lacking))
    with pytest.raises(RecordingError, match="has no field dissipated_friction"):
        _ = run.trace
    tables, problems = readable(run.given.tables)
    assert "/bench/state" in tables
    [problem] = problems
    assert "dissipated_friction" in problem
