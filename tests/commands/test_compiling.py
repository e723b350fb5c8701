"""First use: what is compiled is counted and shown, with an estimate."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from types import SimpleNamespace

from capture_sim.commands import output
from capture_sim.compile_progress import _Compiling
from capture_sim.engine import loop, segment, steps


def test_kernels_are_counted_once_each_and_never_beyond_their_number():
    shown = []
    compiling = _Compiling(lambda done, count: shown.append((done, count)))
    kernels = [k for m in (steps, segment, loop) for k in vars(m).values() if hasattr(k, "py_func")]
    for kernel in [*kernels, *kernels]:  # for other types, or again
        event = SimpleNamespace(data={"dispatcher": kernel})
        compiling.on_start(event)
        compiling.on_end(event)
    done, count = zip(*shown, strict=True)
    distinct = len({kernel.py_func for kernel in kernels})
    assert distinct > 10
    assert list(done) == sorted(done)
    assert done[-1] == distinct <= count[-1]
    assert len(set(count)) == 1


def test_a_pipe_gets_lines_with_an_estimate(monkeypatch, capsys):
    clock = [0.0]
    monkeypatch.setattr(output.time, "monotonic", lambda: clock[0])
    with output.Progress("kernels") as progress:
        for done in range(0, 91, 10):
            clock[0] = float(done)
            progress.at("compiling", done, 90)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "compiling: 20 of 90 kernels, 1 kernels/s, about 70 s left"
    assert lines[-1] == "compiling: 80 of 90 kernels, 1 kernels/s, about 10 s left"


def test_the_first_call_from_python_reports_that_it_compiles(tmp_path):
    script = "import capture_sim; capture_sim.simulate('tilt_0')"
    environment = {**os.environ, "CAPTURE_SIM_CACHE": str(tmp_path)}
    first, second = (
        subprocess.run(
            [sys.executable, "-c", script], env=environment, capture_output=True, text=True
        )
        for _ in range(2)
    )
    lines = first.stderr.splitlines()
    assert lines[0].startswith("capture_sim: compiling the kernels, once for this version")
    assert re.fullmatch(r"capture_sim: compiled in \d+ s", lines[1])
    assert (len(lines), second.stderr) == (2, "")
