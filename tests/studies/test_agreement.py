"""Recorded runs simulated again: identical, different, and mixed with others."""

from __future__ import annotations

import numpy as np
from recorded_bags import rewritten

import capture_sim
from capture_sim.cli import main
from capture_sim.messages.topics import CAPTURE_STATUS, TOPICS, topic_named
from capture_sim.recording.bag import read_bag
from capture_sim.recording.live import LiveRecorder
from capture_sim.recording.read import read_run
from capture_sim.studies.compare.agreement import agreement


def test_simulated_again_a_run_is_identical_and_a_difference_is_found(
    result, path, tmp_path, capsys
):
    assert main(["compare", str(path), "--simulated", "--out", str(tmp_path)]) == 0
    assert "bit-identical" in capsys.readouterr().out
    changed = result.samples.copy()
    changed["q"][4321, 5] = np.nextafter(changed["q"][4321, 5], 1.0)
    found = agreement(result, result.replaced(samples=changed, events=result.events[:-1]))
    (difference,) = found.differences
    assert (difference.name, difference.first) == ("q", 4.321)
    assert 0.0 < difference.largest < 1e-15
    assert not found.same_events
    assert not found.identical


def test_a_missing_event_is_a_difference(path, tmp_path, capsys):
    run = read_bag(path)
    (info,) = run.raw("bench/run_info")
    recorder = LiveRecorder(tmp_path, info)
    for name in ("bench/state", "bench/event"):
        for data in run.raw(name)[: -2 if name == "bench/event" else None]:
            recorder.take(topic_named(name), data)
    file = str(recorder.close().path)
    assert main(["compare", file, "--simulated", "--out", str(tmp_path)]) == 1
    assert "the events differ" in capsys.readouterr().out
    assert (
        main(["compare", file, "--simulated", "--tolerance", "1e-9", "--out", str(tmp_path)]) == 0
    )


def test_samples_of_another_run_are_foreign(result):
    """At other times, or at the run's own once more: neither is passed over."""
    other = result.samples[1000:1958].copy()
    other["t"] += 2e-4
    for mixed in (np.concatenate([result.samples, other]), result.samples[[0, 1, 1, 2]]):
        found = agreement(result.replaced(samples=mixed), result)
        assert found.foreign == (958 if mixed.size > 4 else 1)
        assert not found.identical
    cut = agreement(result.replaced(samples=result.samples[:500], events=()), result)
    assert (cut.compared, cut.foreign, cut.missing) == (500, 0, 0)
    lossy = agreement(result.replaced(samples=result.samples[::2]), result)
    assert lossy.missing == lossy.compared - 1
    assert not agreement(result.replaced(samples=result.samples[:0]), result).identical


def test_a_recording_with_foreign_samples_is_not_identical(path, tmp_path, capsys):
    def doubled(time, message):
        yield time, message
        if getattr(message, "t", 0.0) > 2.0:
            message.t += 2e-4
            yield time, message

    topics = [(t.absolute_name, t.type_name) for t in TOPICS if t is not CAPTURE_STATUS]
    rewritten(path, tmp_path / "bag", doubled, topics)
    assert main(["compare", str(tmp_path / "bag"), "--simulated", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert "do not match this run" in said
    assert "bit-identical" not in said


def test_another_scene_agrees_until_the_tip_touches(path):
    run = read_run(path)
    scene = capture_sim.load_scene("tilt_0", ["friction.mu=0.331"])
    result = capture_sim.simulate(scene)
    found = agreement(run, result)
    assert {d.name for d in found.differences} >= {"q", "v", "friction_force"}
    assert min(d.first for d in found.differences) >= run.first_contact.t
