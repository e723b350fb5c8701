"""Ctrl-C as a launch passes it on: twice, from the terminal and from `ros2 launch`."""

import signal
import subprocess
import sys
import time

import pytest


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
