"""A trial is whole if its file is: without holes, and with the verdict that it was given."""

from dataclasses import replace

import dirty
import pytest

from capture_sim.cli import main
from capture_sim.messages.convert import LaunchAction, Messages, RunDescription
from capture_sim.messages.definitions import blank, typestore
from capture_sim.messages.telemetry import DetectorTelemetry, LauncherTelemetry
from capture_sim.messages.topics import CAPTURE_DETECTOR, LAUNCHER, RUN_INFO, RunSource
from capture_sim.recording.read import read_run
from capture_sim.recording.trial_check import checked_trial
from capture_sim.run.run import detect
from capture_sim.scene.launch_plan import plan_launch
from capture_sim.scene.loading import load_scene

SCENE = load_scene("tilt_p10")
#: s since the release.
CONTACT = dirty.TRUE.first_contact


def record(sent, stamp):
    topic = sent.topic
    return dirty.Record(topic.absolute_name, topic.type_name, stamp + dirty.DELAY, sent.data)


def announced(*waived):
    """Return the announcement of a trial that waives some rules, and its run id."""
    messages = Messages()
    run = RunDescription.of(SCENE, "a trial", [LAUNCHER, CAPTURE_DETECTOR], source=RunSource.TRIAL)
    run = replace(run, waived=waived)
    begin = dirty.RELEASE - 200_000_000
    info = messages.serialise(messages.run_info(run))
    return dirty.Record(RUN_INFO.absolute_name, RUN_INFO.type_name, begin, info), run.run_id


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the records of a trial: announcement, release, sensors and the detector's verdict."""
    messages = Messages()
    info, run_id = announced()
    launcher = LauncherTelemetry(messages, run_id)
    launcher.zero_ns = dirty.RELEASE
    release = launcher.command(0.0, LaunchAction.RELEASE, plan_launch(SCENE))
    records = [
        info,
        record(release, dirty.RELEASE),
        *dirty.clean(),
    ]
    path = dirty.write(tmp_path_factory.mktemp("whole"), "plain", records)
    detector = DetectorTelemetry(messages, run_id)
    detector.zero_ns = dirty.RELEASE
    for status in detect(read_run(path)):
        at = dirty.RELEASE + round(status.t * 1e9)
        records += [record(sent, at) for sent in detector.status(status.t, status)]
        if status.final:
            break
    return records


def shown(capsys):
    captured = capsys.readouterr()
    return captured.out + captured.err


def problems(whole, folder, change=list):
    return checked_trial(dirty.write(folder, "plain", change(whole)))[0]


def test_a_whole_trial_has_no_problem(whole, tmp_path):
    assert problems(whole, tmp_path) == []


@pytest.mark.parametrize("topic", [dirty.CHASER, dirty.TARGET, dirty.JOINTS, dirty.CELL])
@pytest.mark.parametrize("begin, length", [(0.5, 0.15), (CONTACT - 0.05, 0.2), (1.0, 2.0)])
def test_a_hole_is_named_with_its_times(topic, begin, length, whole, tmp_path):
    def holed(records):
        return [r for r in records if r.topic != topic or not begin < r.t < begin + length]

    lines = problems(whole, tmp_path, holed)
    name = topic.lstrip("/")
    assert any(line.startswith(f"{name}: no measurement from {begin:.1f}") for line in lines), lines


@pytest.mark.parametrize("topic", [dirty.JOINTS, dirty.CELL])
@pytest.mark.parametrize("length", [2.0, 99.0])
@pytest.mark.parametrize("last_status", [0.0, 1.0])
def test_without_a_verdict_a_hole_counts_up_to_the_end(topic, length, last_status, whole, tmp_path):
    """The detector's time had ended with a lost source, and what came after counted for nothing."""

    def holed(records):
        return [
            r
            for r in records
            if (r.topic != topic or not 1.2 < r.t < 1.2 + length)
            and (not r.topic.startswith("/capture") or r.t < last_status)
        ]

    lines = problems(whole, tmp_path, holed)
    assert any(line.startswith(f"{topic[1:]}: no measurement from 1.2") for line in lines), lines


@pytest.mark.parametrize("is_nan", [False, True])
@pytest.mark.parametrize("held, is_hole", [(1.15, False), (1.6, True), (8.0, True)])
def test_all_sources_that_stop_at_once_leave_a_hole_up_to_the_hold(
    held, is_hole, is_nan, whole, tmp_path
):
    """As when the network fails, or when encoders send on without a value."""
    launcher = LauncherTelemetry(Messages(), announced()[1])
    launcher.zero_ns = dirty.RELEASE
    abort = launcher.command(held, LaunchAction.ABORT, plan_launch(SCENE))

    def stopped(records):
        until = [r for r in records if r.t < 1.1 and not r.topic.startswith("/capture")]
        void = [r for r in dirty.CHANGES["joints_nan"](records) if 1.1 <= r.t < 9.0]
        void = [r for r in void if is_nan and r.topic == dirty.JOINTS]
        return [*until, *void, record(abort, dirty.RELEASE + round(held * 1e9))]

    lines = problems(whole, tmp_path, stopped)
    for topic in (dirty.CHASER, dirty.TARGET, dirty.JOINTS):
        hole = f"{topic[1:]}: no measurement from 1."
        assert any(line.startswith(hole) for line in lines) is is_hole, lines
    assert not is_hole or any(f"to {held:.1f}" in line for line in lines), lines


def test_a_file_that_ends_in_flight_has_no_hole_at_its_end(whole, tmp_path):
    """The launcher's silence holds the chaser, 0.5 s later: a time that is not in the file."""
    kind = "std_msgs/msg/Bool"
    false = bytes(typestore().serialize_cdr(blank(kind), kind))
    cut = [r for r in whole if r.t < 1.1 and not r.topic.startswith("/capture")]
    cut.append(dirty.Record("/launcher/hold", kind, cut[-1].log_time, false))
    assert not any("no measurement" in line for line in problems(cut, tmp_path))


def test_a_hole_before_the_release_or_after_the_verdict_is_none(whole, tmp_path):
    end = max(r.t for r in whole if r.topic == "/capture/status")
    kept = [r for r in whole if not (-0.5 < r.t < -0.1 or r.t > end + 0.3)]
    assert problems(whole, tmp_path, lambda _: kept) == []


def test_single_lost_frames_are_no_hole(whole, tmp_path):
    def thinned(records):
        return [r for k, r in enumerate(records) if r.topic != dirty.CHASER or k % 7]

    assert problems(whole, tmp_path, thinned) == []


def test_a_verdict_that_the_file_does_not_give_is_named(whole, tmp_path):
    """As of a detector that stood still over the contact, and judged what came after."""

    def late(records):
        return [
            dirty.restamped([r], r.topic, lambda ns: ns + 10**9)[0]
            if r.topic.startswith("/capture")
            else r
            for r in records
        ]

    [line] = problems(whole, tmp_path, late)
    assert line.startswith("verdict: captured at 4.")
    assert "made again from the file captured at 3." in line


def test_a_damaged_or_absent_file_is_named(whole, tmp_path):
    path = dirty.write(tmp_path, "plain", whole)
    path.write_bytes(path.read_bytes()[:-5000])
    assert checked_trial(path)[0][0].startswith("read up to byte")
    path.unlink()
    assert "No such file" in checked_trial(path)[0][0]


def test_an_excluded_topic_is_named(whole, tmp_path):
    [line] = problems(whole, tmp_path, dirty.CHANGES["encoder_inverted"])
    assert "buffer_against_poses" in line


def test_a_rule_that_the_trial_waives_is_waived_wherever_its_file_is_read(whole, tmp_path, capsys):
    """Two names for one frame: `detect` refused the trial, and its row in the table had a doubt."""
    two_names = dirty.CHANGES["frames_differ"](whole[1:])
    for waived, is_used in (((), False), (("frames_differ", "machine_clock"), True)):
        (folder := tmp_path / str(is_used)).mkdir()
        path = dirty.write(folder, "plain", [announced(*waived)[0], *two_names])
        lines, run = checked_trial(path)
        assert any("frames_differ" in line for line in lines) is not is_used
        for read in (run, read_run(path)):  # the recorder makes the row of the first
            assert (read.summary["doubts"] == []) is is_used
            assert ("frames_differ" in read.summary["waived"]) is is_used
        assert (main(["detect", str(path)]) == 0) is is_used
        assert ("as the trial has waived them: clock_steps, frames" in shown(capsys)) is is_used
