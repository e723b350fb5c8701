"""What the integration of whole runs takes, beside an earlier state, in turn with it.

    python -m benchmarks.kernel_times --before CHECKOUT      # a minute

Only ``Bench.advance`` is timed, in one process per state; both stay alive.  In a round each
state takes the least processor time of some runs of every scene.  Where the system puts a process's
code and data in memory, and which core runs it, changes its times by 5 %, so several pairs of
processes are started, and each state comes first in half of the pairs and rounds.  The table has
medians over the rounds of all pairs, of the ratios too, the least and the largest of the pairs'
ratios, and the largest difference of touches and extremes, per the largest value of its kind:
between the states, and within the earlier one by a change of rtol as small as rounding.
"""

from __future__ import annotations

import gc
import json
import statistics
import sys
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.before import ROOT, Server
from benchmarks.pages import ratio, table, write_parts

_RTOL = 1e-8  # of the packaged scenes
_STIFF = ["contact.law=exact", "contact.restitution=1e-3"]
#: Scene, what is changed in it, and where the run ends (s; 0: where the scene has it).
CASES = {
    "paper_designed to 0.35 s": ("paper_designed", [], 0.35),
    "the same at rtol 1e-6": ("paper_designed", ["run.rtol=1e-6"], 0.35),
    "paper_designed": ("paper_designed", [], 0.0),
    "tilt_0": ("tilt_0", [], 0.0),
    "tilt_p10": ("tilt_p10", [], 0.0),
    "tilt_m10": ("tilt_m10", [], 0.0),
    "paper_designed to 0.6 s, mu = 2": ("paper_designed", ["friction.mu=2"], 0.6),
    "the same, probe of 27 kg/m^3": ("paper_designed", ["probe.density=27"], 0.6),
    "the same, exact law with e = 1e-3": ("paper_designed", _STIFF, 0.6),
}
#: The scenes that a change of the integrator is judged by: the median of their ratios.
JUDGED = ("paper_designed", "tilt_0", "tilt_p10", "tilt_m10")


def results(scene: Any, t_end: float) -> dict[str, list[float]]:
    """Run a scene; return the numbers that a user reads, by name."""
    from capture_sim import Bench

    bench = Bench(scene)
    bench.advance(np.array([t_end] if t_end else []))
    touches, extremes = bench.touches, bench.extremes.before_latch
    found = {f"touch {name}": touches[name].tolist() for name in touches.dtype.names}
    if bench.done:  # before the end they do not cover the last step
        found |= {name: [float(extremes[name])] for name in extremes.dtype.names}
    return found


def serve(times: int) -> None:
    """Answer each line on standard input with the least times of all cases, ms, as JSON.

    Two lines before have the results of all cases: as they are, and with rtol changed by 1e-13.
    """
    from capture_sim import Bench, load_scene  # public names: deep ones differ between states

    scenes = [(load_scene(name, changes), t_end) for name, changes, t_end in CASES.values()]
    gc.disable()
    changed = [f"run.rtol={_RTOL * (1.0 + 1e-13)!r}"]
    for more in ([], changed):
        runs = [(load_scene(name, more + own), t) for name, own, t in CASES.values()]
        print(json.dumps([results(scene, t) for scene, t in runs]), flush=True)
    for _ in sys.stdin:
        found = []
        for scene, t_end in scenes:
            spent = []
            for _ in range(times):
                bench = Bench(scene)
                until = np.array([t_end] if t_end else [])
                began = time.process_time()
                bench.advance(until)
                spent.append(time.process_time() - began)
            found.append(1e3 * min(spent))
        print(json.dumps(found), flush=True)


def apart(first: dict[str, list[float]], last: dict[str, list[float]]) -> str:
    """Return the largest difference of two results, each per the largest of its kind."""
    if any(len(first[name]) != len(last[name]) for name in first):
        return "other touches"
    largest = 0.0
    for name, values in first.items():
        scale = max(map(abs, values), default=0.0)
        if scale > 0.0:
            differences = np.abs(np.subtract(values, last[name]))
            largest = max(largest, float(differences.max()) / scale)
    return f"{largest:.0e}"


def measure_pair(
    states: list[Path], rounds: int, times: int
) -> tuple[list[list[dict[str, list[float]]]], NDArray[np.float64]]:
    """Start a process per state; return the results of each, and CPU times in ms.

    Results of a state are a pair of lists with a dictionary per case: as it is, and with rtol
    changed.  CPU times have the axes round, state and case.
    """
    servers = [Server(__file__, state, times) for state in states]
    results_of_states = [[server.answer() for _ in range(2)] for server in servers]
    spent = []
    for k in range(rounds):
        in_turn = servers if k % 2 else servers[::-1]
        answers = [server.ask() for server in in_turn]
        spent.append(answers if k % 2 else answers[::-1])
    for server in servers:
        server.end()
    return results_of_states, np.array(spent)


def kernels(asked: Namespace, _: Path) -> list[str]:
    """Both states in turn."""
    states = [ROOT] if asked.before is None else [asked.before.resolve(), ROOT]
    pairs = []
    for k in range(asked.pairs):
        found, spent = measure_pair(states[:: 1 if k % 2 else -1], asked.rounds, asked.times)
        pairs.append((found, spent) if k % 2 else (found[::-1], spent[:, ::-1]))
    found = pairs[0][0]
    columns = (found[-1][0], found[0][1])
    difference = [[apart(*pair) for pair in zip(found[0][0], c, strict=True)] for c in columns]
    times = np.array([spent for _, spent in pairs])  # pair, round, state, case
    by_pair = np.median(times[:, :, -1] / times[:, :, 0], axis=1)
    ratios = np.median(times[:, :, -1] / times[:, :, 0], axis=(0, 1))
    rows = [
        [name, *(f"{ms:.3g}" for ms in np.median(times, axis=(0, 1))[:, k]), ratio(ratios[k])]
        + [f"{ratio(by_pair[:, k].min())} to {ratio(by_pair[:, k].max())}"]
        + [column[k] for column in difference]
        for k, name in enumerate(CASES)
    ]
    judged = statistics.median(ratios[list(CASES).index(name)] for name in JUDGED)
    head = ["run, CPU time, ms", *(["before", "now"] if len(states) > 1 else ["now"])]
    head += ["now / before", f"of {asked.pairs} pairs", "results differ by"]
    return [
        table([*head, "rtol x (1 + 1e-13) before"], rows),
        "",
        f"Median of {', '.join(JUDGED)}: {ratio(judged)}.",
    ]


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(int(sys.argv[2]))
    else:
        write_parts(
            None,
            __doc__,
            {"kernels": kernels},
            before=(None, "checkout of an earlier state"),
            pairs=(8, "of processes, one pair after the other"),
            rounds=(6, "of all runs, per pair"),
            times=(3, "that a run is repeated in a round"),
        )
