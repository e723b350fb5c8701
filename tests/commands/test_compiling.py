"""First use: what is compiled is counted and shown, with an estimate."""

from __future__ import annotations

from types import SimpleNamespace

from capture_sim.base.compiled.progress import _CompilationCounter
from capture_sim.commands import output
from capture_sim.dynamics.engine import loop, segment, steps


def test_kernels_are_counted_once_each_and_never_beyond_their_number():
    shown = []
    compiling = _CompilationCounter(lambda done, count: shown.append((done, count)))
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
