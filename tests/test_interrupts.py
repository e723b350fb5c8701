"""Ctrl-C as a launch passes it on: twice, from the terminal and from `ros2 launch`."""

import signal
import subprocess
import sys
import time

import pytest

import capture_sim
from capture_sim.recording import read_run, write_run


@pytest.mark.parametrize("gap", [0.0003, 0.001, 0.004])
def test_interrupted_twice_ends_in_order(tmp_path, gap):
    pytest.importorskip("rclpy")
    node = subprocess.Popen(
        [sys.executable, "-m", "capture_sim.nodes.recorder"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        # as a shell has it for what runs in its foreground
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        lines = []
        while "ready" not in "".join(lines[-1:]):
            line = node.stderr.readline()
            assert line, lines
            lines.append(line)
        for _ in range(8):
            if node.poll() is None:
                node.send_signal(signal.SIGINT)
            time.sleep(gap)
        assert node.wait(timeout=20) == 0
        assert "Traceback" not in node.stderr.read()
    finally:
        if node.poll() is None:
            node.kill()
            node.wait()
        node.stderr.close()


def test_signals_that_come_together_interrupt_once():
    pytest.importorskip("rclpy")
    from capture_sim.nodes.running import _Interrupt

    interrupt = _Interrupt()
    with pytest.raises(KeyboardInterrupt):
        interrupt(signal.SIGINT, None)
    interrupt(signal.SIGINT, None)
    interrupt(signal.SIGTERM, None)
    time.sleep(_Interrupt.TOGETHER)
    with pytest.raises(KeyboardInterrupt):
        interrupt(signal.SIGINT, None)


@pytest.mark.parametrize("followers", [(), ("recorder",)])
def test_interrupted_replay_says_so_by_its_status(tmp_path, followers):
    pytest.importorskip("rclpy")
    scene = capture_sim.load_scene("tilt_0", ["run.t_end=3.0"])
    path = write_run(capture_sim.simulate(scene), tmp_path / "tilt_0.mcap")
    command = [sys.executable, "-m", "capture_sim.cli", "replay", str(path), "--rate", "0.05"]
    if followers:
        command += ["--with", *followers, "--out", str(tmp_path / "out")]
    replay = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        if followers:  # its file is there once it plays
            deadline = time.monotonic() + 60.0
            while not list((tmp_path / "out").glob("*.mcap")) and time.monotonic() < deadline:
                time.sleep(0.05)
        else:
            time.sleep(4.0)
        assert replay.poll() is None
        replay.send_signal(signal.SIGINT)
        out, err = replay.communicate(timeout=30)
        assert replay.returncode == 130, out + err
        assert "interrupted" in err
        assert "Traceback" not in out + err
        if followers:
            (file,) = (tmp_path / "out").glob("*.mcap")
            assert read_run(file).raw("bench/run_info")
    finally:
        if replay.poll() is None:
            replay.kill()
            replay.wait()
