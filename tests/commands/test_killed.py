"""Commands that are killed at any moment: no process is left, and no half file has a name."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from cases import cases

from capture_sim import simulate
from capture_sim.recording.offline import write_run

#: Commands by name, each with the time within which it is killed, s.
COMMANDS = {
    "run": (["run", "tilt_0", "tilt_p10", "--out", "o"], 4.0),
    "view": (["view", "a.mcap", "a.mcap", "--figures", "--out", "o"], 3.0),
    "report": (["report", "a.mcap", "--out", "o/page.html"], 2.0),
    "sweep": (["sweep", "tilt_0", "--vary", "buffer.c_A=uniform(5,30)", "--runs", "300"], 6.0),
    "design": (["design", "paper_designed", "--candidates", "400", "--out", "o"], 6.0),
    "bench": (["bench", "tilt_0", "--out", "o"], 8.0),
}
COMMANDS["sweep"][0].extend(["--workers", "2", "--out", "o/t.csv"])
COMMANDS["design"][0].extend(["--workers", "2"])
SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)


def processes_of(mark):
    """Return the command lines of processes whose environment has a mark."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if mark.encode() in (entry / "environ").read_bytes():
                    command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                    if command:
                        found.append(command)
            except OSError:
                continue
    return found


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write_run(simulate("tilt_0"), tmp_path_factory.mktemp("recorded") / "a.mcap")


@pytest.mark.parametrize("name", cases(few=["view", "sweep"], all=list(COMMANDS)))
def test_a_killed_command_leaves_no_process_and_no_half_file(name, recording, tmp_path):
    arguments, longest = COMMANDS[name]
    program = [sys.executable, "-m", "capture_sim.cli"]
    (tmp_path / "a.mcap").write_bytes(recording.read_bytes())
    source = random.Random(name)
    for k in range(cases(few=1, all=9)):
        mark = f"CAPTURE_SIM_TEST_MARK={name}{os.getpid()}_{k}"
        key, _, value = mark.partition("=")
        with subprocess.Popen(
            [*program, *arguments],
            cwd=tmp_path,
            env={**os.environ, key: value},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as process:
            time.sleep(source.uniform(0.3, longest))
            process.send_signal(source.choice(SIGNALS))
            process.wait(600)
        deadline = time.monotonic() + 600.0
        while (left := processes_of(mark)) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert left == [], (name, k)
        # what was killed outright keeps its name of an unfinished file
        files = [path for path in tmp_path.rglob("*") if path.is_file()]
        named = [path for path in files if not path.name.startswith(".")]
        for path in named:
            head, size = path.read_bytes()[:8], path.stat().st_size
            if path.suffix == ".png":
                assert head.startswith(b"\x89PNG"), path
                assert path.read_bytes().rstrip()[-8:-4] == b"IEND", path
            if path.suffix == ".html":
                assert path.read_text().rstrip().endswith("</html>"), path
            assert size or path.suffix == ".journal", path
