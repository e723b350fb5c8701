"""Nodes that stand still for a while, or are killed, and the run after that."""

import signal
import time
from pathlib import Path

import pytest

from capture_sim.recording.bag import read_bag

NODES = 20
#: s; a lease of 6 s, as it was, ran out on one side only: config/fast_dds.xml.
STOP = 7.0
INTERVAL = 0.4  # s, between the stops of two nodes: some sleep while others wake


@pytest.mark.long
def test_twenty_nodes_each_stopped_for_a_while_are_all_in_the_next_run(start, tmp_path):
    names = [f"recorder_{i}" for i in range(NODES)]
    nodes = [start("recorder", out=tmp_path / name, __node=name) for name in names]
    for node in nodes:
        node.wait_for("ready")
    begin = time.monotonic()
    events = [(i * INTERVAL, i, signal.SIGSTOP) for i in range(NODES)]
    events += [(i * INTERVAL + STOP, i, signal.SIGCONT) for i in range(NODES)]
    for due, i, signum in sorted(events):
        time.sleep(max(0.0, begin + due - time.monotonic()))
        nodes[i].process.send_signal(signum)
    short = "[run.t_end=0.6, run.rate=100]"
    waited = f"[{', '.join(names)}]"
    patient = {"reader_timeout": 60.0, "start_timeout": 240.0}
    simulator = start("simulator", rtf=0.0, wait_for=waited, overrides=short, **patient)
    simulator.wait_for("done, ")
    assert simulator.status() == 0, simulator.text
    for node in nodes:
        assert node.end() == 0, node.text
    for name in names:
        assert read_bag(tmp_path / name / "tilt_0.mcap").complete


def test_a_stopped_node_is_named_and_heard_again(start, tmp_path):
    launcher = start("launcher")
    recorder = start("recorder", out=tmp_path)
    for node in (launcher, recorder):
        node.wait_for("ready")
    # a run with both: they have heard each other
    assert start("simulator", rtf=0.0, wait_for="[launcher, recorder]").status() == 0
    recorder.process.send_signal(signal.SIGSTOP)
    launcher.wait_for("/recorder: connected, but not heard for 5 s")
    recorder.process.send_signal(signal.SIGCONT)
    launcher.wait_for("/recorder: heard again")
    assert "not heard" not in recorder.text  # it stood still itself


def test_a_node_has_no_files_of_dds_that_a_kill_could_leave(start, tmp_path):
    recorder = start("recorder", out=tmp_path)
    recorder.wait_for("ready")
    maps = Path(f"/proc/{recorder.process.pid}/maps").read_text()
    # what it does not map it cannot leave behind, whenever it is killed
    assert "libfastrtps" in maps
    assert "/dev/shm/fastrtps" not in maps
