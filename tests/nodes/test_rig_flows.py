"""Sessions of several trials on a bench, and a recorder's disk that fails in them."""

import resource
import signal

import numpy as np
from bench_processes import Client, processes
from capture_sim.srv import BeginTrial
from forked import Forked
from rig_session import OUTCOMES, PACE, RIG, Session, check
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from capture_sim.messages.topics import CHASER_POSE
from capture_sim.nodes.node import LATCHED
from capture_sim.nodes.recorder import OVERTAKING
from capture_sim.recording.clock import stamps_of
from capture_sim.recording.read import read_run

#: Time between two trials of a session, s of the bench.
IDLE = 10.0


def check_messages(path, *, release):
    """Check that a recording holds its own messages and nothing else: none of the idle time."""
    run = read_run(path)
    assert run.problems == ()
    arrivals, stamps = run.log_times(CHASER_POSE), stamps_of(run.columns(CHASER_POSE))
    announced = run.log_times("bench/run_info")[0]
    assert announced - arrivals[0] < OVERTAKING + 0.1e9
    assert np.diff(stamps).max() < 0.5e9, "a gap in the poses"
    assert 0 < run.clock.release - stamps[0] - release * 1e9 < 2e9 * PACE


def test_six_trials_in_a_session_with_the_launcher(tmp_path, capsys):
    assert len(RIG.read_text().splitlines()) <= 140
    assert "capture_sim." not in RIG.read_text()
    with processes(Forked) as start, Client() as client:
        session = Session(start, client, tmp_path)
        with session.bench(outcomes=f"[{', '.join(OUTCOMES)}]"):
            for outcome in OUTCOMES * 2:
                session.launch(IDLE)
                assert not client.ask(Trigger, "/launcher/launch").success  # pressed twice
                session.await_verdict()
                live, path = session.end()
                assert live.label == outcome
                check(live, path, capsys)
                check_messages(path, release=0.0)
    names = {path.name for path in tmp_path.glob("*.mcap")}
    assert names == {"tilt_0.mcap", *(f"tilt_0_{k}.mcap" for k in range(2, 7))}


def test_six_trials_in_a_session_without_launcher(tmp_path, capsys):
    with processes(Forked) as start, Client() as client:
        session = Session(start, client, tmp_path, has_launcher=False)
        hold = client.node.create_publisher(Bool, "launcher/hold", LATCHED)
        with session.bench(outcomes=f"[{', '.join(OUTCOMES)}]"):
            for trial, outcome in enumerate(OUTCOMES * 2):
                if trial == 1:
                    session.recorder.process.send_signal(signal.SIGINT)
                    assert session.recorder.status() == 0
                session.wait(IDLE)
                session.statuses.clear()
                begin = client.ask(BeginTrial, "/capture_detector/begin_trial", scene="tilt_0")
                assert begin.success, begin.message
                if trial == 1:  # the recorder starts late, in the trial
                    session.recorder, session.recorded = session.start_recorder(), 0
                    session.recorder.wait_for("recording in")
                else:
                    session.wait(4.0)
                hold.publish(Bool(data=False))
                session.await_verdict()
                live, path = session.end("capture_detector")
                assert live.label == outcome
                check(live, path, capsys)
                hold.publish(Bool(data=True))


def test_disk_that_is_full_in_the_second_trial_and_stalls_in_the_fourth(tmp_path, capsys):
    """A limit of the file's size is the full disk, a writing thread that waits the stalled one."""
    stalled = tmp_path / "stalled"
    stall = f"""
        import os, time
        from capture_sim.recording import live
        from capture_sim.recording.write import RunWriter
        write = RunWriter.write
        def write_or_wait(self, *message):
            while os.path.exists({str(stalled)!r}):
                time.sleep(0.05)
            write(self, *message)
        RunWriter.write = write_or_wait
        live.CLOSE_LIMIT = 1.0
    """
    with processes(Forked) as start, Client() as client:
        session = Session(start, client, tmp_path, change=stall)
        recorder = session.recorder
        with session.bench(outcomes="[captured, rebound, missed]"):
            first = session.try_outcomes(capsys, "captured")
            whole = first.read_bytes()
            limits = resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE)
            full = (len(whole) // 3, limits[1])
            resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, full)
            session.launch()
            session.await_verdict()
            assert client.ask(Trigger, "/launcher/end_trial").success
            recorder.wait_for("tilt_0_2.mcap: cannot write: File too large")
            session.recorded += 1
            resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, limits)
            session.try_outcomes(capsys, "missed")
            assert first.read_bytes() == whole
            assert recorder.text.count("cannot write") == 1
            assert "Traceback" not in recorder.text
            session.launch()
            session.wait(1.0)
            stalled.touch()
            session.wait(1.0)
            recorder.process.send_signal(signal.SIGTERM)
            assert recorder.status() == 0
            assert "the disk has written nothing for 1 s" in recorder.text
            assert "Traceback" not in recorder.text
