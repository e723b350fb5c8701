"""Ctrl-C as a launch passes it on: twice, from the terminal and from `ros2 launch`."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest
from cases import cases

import capture_sim
from capture_sim import load_scene
from capture_sim.base.interrupts import in_worker, watch_signals
from capture_sim.commands.suite import run_suite
from capture_sim.recording.bag import read_bag
from capture_sim.recording.offline import write_run
from tests.nodes.bench_processes import wait_until

GAPS = (0.0003, 0.001, 0.004)  # s


def test_interrupted_twice_ends_in_order(start, tmp_path):
    nodes = {gap: start("recorder", out=tmp_path, __node=f"r{i}") for i, gap in enumerate(GAPS)}
    for gap, node in nodes.items():
        node.wait_for("ready")
        while node.process.poll() is None:  # to the very end of the process
            node.process.send_signal(signal.SIGINT)
            time.sleep(gap)
    for node in nodes.values():
        assert node.status() == 0, node.text
        assert "Traceback" not in node.text


def test_interrupt_while_the_callbacks_begin(start):
    node = start(
        "launcher",
        """
        import time
        serve = node.LauncherNode.serve
        def slowly(self, limit=0.0):
            print("begun", flush=True)
            time.sleep(0.5)
            serve(self, limit)
        node.LauncherNode.serve = slowly
        """,
    )
    node.wait_for("begun")
    node.process.send_signal(signal.SIGINT)
    assert node.status() == 0, node.text


def test_signals_set_an_event_and_raise_nothing():
    stop, over = threading.Event(), threading.Event()
    other = threading.Thread(target=over.wait, daemon=True)  # may be the one that gets the signal
    other.start()
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        restore = watch_signals(stop, (signal.SIGINT, signal.SIGTERM))
        for signum in (signal.SIGINT, signal.SIGTERM):
            for _ in range(100):
                os.kill(os.getpid(), signum)
            assert stop.wait(60.0)
            stop.clear()
            time.sleep(0.1)
        restore()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1.0)
    finally:
        signal.signal(signal.SIGTERM, before)
        over.set()


def ended(program, tmp_path, *, words="", after=0.0):
    """Run a program, interrupt it so long after its words; return its status and what it said."""
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", textwrap.dedent(program)],
        cwd=tmp_path,
        env=dict(os.environ, CAPTURE_SIM_CACHE=str(tmp_path / "cache")),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        said = ""
        while words not in said:
            line = process.stdout.readline()
            assert line, said
            said += line
        if words:
            time.sleep(after)
            process.send_signal(signal.SIGINT)
        said += process.communicate(timeout=300)[0]
        return process.returncode, said
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def test_interrupt_within_a_destructor_is_not_lost(tmp_path):
    status, said = ended(
        """
        import os, signal
        from capture_sim.nodes.base.node import BenchNode
        from capture_sim.nodes.base.process import run

        class Loses:
            def __del__(self):
                os.kill(os.getpid(), signal.SIGINT)
                for _ in range(1000):
                    pass
                print("cleaned up")

        class Bench(BenchNode):
            def __init__(self):
                super().__init__("bench")

            def work(self):
                Loses()
                self.wait()
                return 1

        raise SystemExit(run(Bench))
        """,
        tmp_path,
    )
    assert (status, said) == (0, "cleaned up\n")


@pytest.mark.parametrize("status", cases(few=[1], all=[0, 1]))
def test_end_is_bounded_where_dds_spins_with_the_lock_of_python(tmp_path, status):
    ended_with, said = ended(
        f"""
        import ctypes
        from capture_sim.nodes.base import process
        from capture_sim.nodes.base.node import BenchNode

        class Bench(BenchNode):
            def __init__(self):
                super().__init__("bench")

            def work(self):
                print("at work")
                return {status}

            def destroy_node(self):
                print("never ends")
                ctypes.PyDLL(None).sleep(50)

        process.DDS_SHUTDOWN_TIMEOUT = 1
        raise SystemExit(process.run(Bench))
        """,
        tmp_path,
    )
    assert (ended_with, said) == (status, "at work\nnever ends\n")


def test_shutdown_is_bounded_where_a_disk_is_stalled(start, tmp_path):
    """The callback that writes does not come back, and the node still follows Ctrl-C."""
    stalled = """
        import threading
        from capture_sim.nodes.base import process
        process.SHUTDOWN_TIMEOUT = 2.0
        take = node.RecorderNode._record
        def stall(self, topic, data):
            take(self, topic, data)
            if self.run is not None:
                print("stalled", flush=True)
                threading.Event().wait()
        node.RecorderNode._record = stall
    """
    recorder = start("recorder", stalled, out=tmp_path)
    simulator = start("simulator", wait_for="[recorder]")
    recorder.wait_for("stalled")
    recorder.process.send_signal(signal.SIGTERM)
    assert recorder.status() == 1
    assert "no shutdown within 2 s, e.g. of a stalled disk" in recorder.text
    simulator.process.send_signal(signal.SIGINT)
    assert simulator.status() == 0, simulator.text


#: At any moment of loading the compiler and of compiling; where that is over, in what comes then
COMPILING = {
    "command": (
        "from capture_sim.cli import main; raise SystemExit(main(['run', 'tilt_0']))",
        130,
        0.7,
    ),
    "node": ("from capture_sim.nodes.simulator import main; raise SystemExit(main())", 0, 2.5),
    "loop": (  # it says nothing before
        "from capture_sim.nodes.loop_simulator import main; print('compiling'); "
        "raise SystemExit(main())",
        0,
        2.5,
    ),
}


@pytest.mark.parametrize("name", cases(few=["node"], all=list(COMPILING)))
def test_compiling_is_interrupted_at_once(tmp_path, name):
    program, status, after = COMPILING[name]
    ended_with, said = ended(program, tmp_path, words="compiling", after=after)
    assert "Traceback" not in said
    assert ended_with == status, said


# sends Ctrl-C to this process while NumPy is loaded
AT_NUMPY = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
class AtNumpy:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy.linalg":
            sys.meta_path.remove(self)
            print("loading", flush=True)
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, AtNumpy())
"""


@pytest.mark.parametrize(
    "program, status",
    [
        ("from capture_sim.cli import main; raise SystemExit(main(['run', 'tilt_0']))", 130),
        ("from capture_sim.nodes.start import recorder; raise SystemExit(recorder())", 0),
    ],
)
def test_interrupt_while_numpy_is_loaded(program, status, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", AT_NUMPY + program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.stdout.startswith("loading")
    assert "Traceback" not in done.stderr
    assert done.returncode == status, done.stderr
    assert done.stderr.count("\n") <= 2


def test_work_apart_gives_and_raises_as_in_place():
    seen = []

    def work():
        seen.append(threading.current_thread())
        return 1.0

    assert in_worker(work) == 1.0
    assert seen[0] is not threading.main_thread()
    with pytest.raises(ZeroDivisionError):
        in_worker(lambda: 1 / 0)
    # from another thread it stays there: that one gets no signals
    other = threading.Thread(target=in_worker, args=(work,))
    other.start()
    other.join()
    assert seen[1] is other


def test_interrupt_within_work_apart_is_not_lost():
    over = threading.Event()

    class Loses:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.1)

    def work():
        Loses()
        over.wait(20.0)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            in_worker(work)
    finally:
        over.set()
        signal.signal(signal.SIGINT, before)


def test_interrupted_replay_says_so_by_its_status(tmp_path):
    scene = capture_sim.load_scene("tilt_0", ["run.t_end=3.0"])
    path = write_run(capture_sim.simulate(scene), tmp_path / "tilt_0.mcap")
    command = [sys.executable, "-m", "capture_sim.cli", "replay", str(path), "--rtf", "0.05"]
    command += ["--with", "recorder", "--out", str(tmp_path / "out")]
    replay = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        # its file is there once it plays
        wait_until(lambda: list((tmp_path / "out").glob("*.mcap")))
        assert replay.poll() is None
        replay.send_signal(signal.SIGINT)
        out, err = replay.communicate(timeout=300)
        # Python ends by the signal itself if that came within exec of a text, as rosbags does it
        # for its classes; a shell shows 130 for either
        assert replay.returncode in (130, -signal.SIGINT), out + err
        assert "interrupted" in err
        assert "Traceback" not in out + err
        (file,) = (tmp_path / "out").glob("*.mcap")
        assert read_bag(file).raw("bench/run_info")
    finally:
        if replay.poll() is None:
            replay.kill()
            replay.wait()


def test_interrupt_while_nodes_are_started_ends_them_too(tmp_path, monkeypatch, capfd):
    started = []
    start = subprocess.Popen

    def start_and_interrupt(*args, **options):
        started.append(start(*args, **options))
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.05)
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start_and_interrupt)
    with pytest.raises(KeyboardInterrupt):
        run_suite([load_scene("tilt_0")], tmp_path)
    assert len(started) == 4
    assert [process.returncode for process in started] == [0] * 4
    assert "Traceback" not in capfd.readouterr().out
