"""The node suite as measured: start, pace, loss, same bits, memory.

    python -m benchmarks.node_suite                       # all parts, about 20 minutes
    python -m benchmarks.node_suite paced resets --resets 50

Starts the real nodes, each in a process of its own, over real DDS on loopback; writes the parts of
docs/evidence/node_suite.md.  Every wait has a limit: a node that hangs fails its part.
"""

from __future__ import annotations

import random
import re
import subprocess
import sys
import time
from argparse import Namespace
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import numpy as np
import psutil

from benchmarks.pages import Spread, table, write_parts
from capture_sim import load_scene, simulate
from capture_sim.nodes.simulation.control import Code, State
from capture_sim.recording.bag import read_bag
from tests.nodes.bench_processes import Client, Simulation, processes, statuses, wait_until
from tests.nodes.forked import Forked

FOLLOWERS = ("launcher", "capture_detector", "recorder")
NODES = ("simulator", *FOLLOWERS)

#: Sleeps to each of n ticks at 1 kHz; prints by how much it was late, us, as the simulator does.
BARE = """
import sys, time, numpy
late, start = [], time.monotonic()
for i in range(int(sys.argv[1])):
    due = start + i * 1e-3
    time.sleep(max(due - time.monotonic(), 0.0))
    late.append(1e6 * (time.monotonic() - due))
print(*numpy.percentile(late, (50, 99, 99.9, 100)).round().astype(int))
"""


#: As BARE, each second in turn by time.sleep and in the executor of a node; ticks are s / 1000.
#: It ends without DDS's own end, which may spin for ever while another participant comes or goes.
WAITS = """
import os, sys, time, numpy
import rclpy
from rclpy.experimental import EventsExecutor
rclpy.init()
executor = EventsExecutor()
executor.add_node(rclpy.create_node("waiting"))
late = {"time.sleep": [], "executor": []}
for how in [*late] * int(sys.argv[1]):
    start = time.monotonic()
    for i in range(1000):
        due = start + i * 1e-3
        while (left := due - time.monotonic()) > 0.0:
            time.sleep(left) if how == "time.sleep" else executor.spin_once(left)
        late[how].append(1e6 * (time.monotonic() - due))
for how, values in late.items():
    print(how, *numpy.percentile(values, (50, 99, 99.9, 100)).round().astype(int), flush=True)
os._exit(0)
"""
#: A process that measures for so long gets this much longer, s, to start and to end.
MARGIN = 60.0


def burn(stack: ExitStack, count: int) -> None:
    """Keep the machine busy until the stack is left."""
    for _ in range(count):
        burner = subprocess.Popen([sys.executable, "-c", "while True: pass"])
        stack.callback(burner.wait)
        stack.callback(burner.kill)


def output(seconds: float, *command: str) -> str:
    """Return what Python prints for a command that measures for so long."""
    done = subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, timeout=seconds + MARGIN
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


class Suite:
    """Nodes of a bench, the simulator waiting for the others.

    Parameters
    ----------
    start
        As :func:`processes` gives it.
    out
        Folder of the recordings.
    order
        Of the start; seconds among the names are pauses.
    simulator
        Its parameters.
    """

    def __init__(self, start, out, order=NODES, **simulator):
        self.out, self.nodes = out, {}
        others = [name for name in FOLLOWERS if name in order]
        given = {
            "simulator": {"wait_for": f"[{','.join(others)}]", **simulator},
            "recorder": {"out": out},
        }
        for name in order:
            if isinstance(name, float):
                time.sleep(name)
            else:
                self.nodes[name] = start(name, **given.get(name, {}))

    def shares(self, seconds: float) -> dict[str, float]:
        """Return the share of a core that each node takes, from a moment after the release on."""
        self.nodes["simulator"].wait_for("released")
        time.sleep(1.0)
        before = self.spent()
        time.sleep(seconds)
        return {name: (spent - before[name]) / seconds for name, spent in self.spent().items()}

    def spent(self) -> dict[str, float]:
        """Return the processor time of each node that lives, with its children, s."""
        found = {}
        for name, node in self.nodes.items():
            with suppress(psutil.NoSuchProcess):
                process = psutil.Process(node.process.pid)
                family = [process, *process.children(recursive=True)]
                found[name] = sum(sum(one.cpu_times()[:2]) for one in family)
        return found

    def end(self) -> str:
        """Wait until all have ended well; return what the simulator said of its last run."""
        assert not any(statuses(self.nodes).values()), "\n".join(
            node.text for node in self.nodes.values()
        )
        return self.nodes["simulator"].text.rpartition("done, ")[2]

    def recorded(self):
        """Return the newest recording; None where there is none."""
        files = sorted(self.out.glob("*.mcap"), key=lambda path: path.stat().st_mtime)
        return read_bag(files[-1]) if files else None


def endless(seconds: float) -> str:
    """Return the changes after which a run of tilt_0 takes so long: nothing latches."""
    return str(["latch=null", f"run.t_end={seconds}"])


def achieved(said: str) -> float:
    """Return the real-time factor from the simulator's line."""
    return float(re.search(r"\(([\d.]+) x real time\)", said)[1])


def measure_start(options: Namespace, folder: Path) -> list[str]:
    took = []
    for _ in range(options.times):
        with processes() as start:
            began = time.monotonic()
            node = start("simulator", overrides=endless(0.1))
            node.wait_for("released")
            took.append(time.monotonic() - began)
            assert node.status() == 0
    return [
        "From the start of a simulator alone, kernels compiled, to its first sample: median "
        f"{Spread.of(took).median:.2f} s of {len(took)}, {min(took):.2f} to {max(took):.2f}."
    ]


def measure_paced(options: Namespace, folder: Path, burners: int = 0) -> list[str]:
    rows, factors, messages, lost = [], [], [], []
    for i in range(options.times):
        with ExitStack() as stack:
            burn(stack, burners)
            start = stack.enter_context(processes())
            suite = Suite(start, folder / str(i), rtf=1.0, overrides=endless(options.seconds))
            suite.nodes["simulator"].wait_for("released")
            bare = output(options.seconds, "-c", BARE, str(int(1000 * options.seconds)))
            said = suite.end()
        ticks = re.search(r"late by ([\d, -]+) us", said)[1].split(",")
        rows += [[f"simulator, run {i + 1}", *ticks]]
        rows += [[f"sleep loop, run {i + 1}", *bare.split()]]
        run = suite.recorded()
        factors.append(f"{achieved(said):.5f}")
        messages.append(sum(run.topics.values()))
        lost += run.problems
    counts = ", ".join(map(str, messages))
    return [
        f"{options.times} times {options.seconds:g} s of state at 1 kHz and standard topics at "
        f"100 Hz: {counts} messages recorded, lost: {'; '.join(lost) or 'none'}; real-time "
        f"factors {', '.join(factors)}.",
        "",
        table(["lateness of a tick, us", "p50", "p99", "p99.9", "max"], rows),
    ]


def measure_busy(options: Namespace, folder: Path) -> list[str]:
    return measure_paced(options, folder, burners=4)


def measure_unpaced(options: Namespace, folder: Path) -> list[str]:
    factors, spent, lost = [], {}, []
    for i in range(options.times):
        with processes() as start:
            suite = Suite(start, folder / str(i), rtf=0.0, overrides=endless(options.seconds))
            simulator = suite.nodes["simulator"]
            simulator.wait_for("released")
            before = suite.spent()
            while "done, " not in simulator.text and simulator.process.poll() is None:
                spent = {name: value - before[name] for name, value in suite.spent().items()}
                time.sleep(0.02)
            factors.append(f"{achieved(suite.end()):.1f}")
            lost += suite.recorded().problems
    shares = ", ".join(f"{name} {value:.2f}" for name, value in spent.items())
    short, missing = 0, []
    for i in range(options.suites):  # under load
        with ExitStack() as stack:
            burn(stack, 2)
            start = stack.enter_context(processes(Forked))
            out = folder / f"short_{i}"
            Suite(start, out, rtf=0.0, scenes="[tilt_0, tilt_p10]").end()
        runs = [read_bag(path) for path in sorted(out.glob("*.mcap"))]
        short += len(runs)
        missing += [problem for run in runs for problem in run.problems]
    return [
        f"{options.seconds:g} simulated seconds, {options.times} times: {', '.join(factors)} times "
        f"real time, lost: {'; '.join(lost) or 'none'}. CPU time of the nodes in the last run, "
        f"s: {shares}.",
        "",
        f"With two busy processes, {options.suites} suites of two runs each (tilt_0, tilt_p10): "
        f"{short} recordings, lost: {'; '.join(missing) or 'none'}.",
    ]


def measure_waits(options: Namespace, folder: Path) -> list[str]:
    rows = []
    for i in range(2 * options.times):
        with ExitStack() as stack:
            busy = 2 * (i % 2)
            burn(stack, busy)
            turns = max(1, round(options.seconds / 6.0))
            said = output(2.0 * turns, "-c", WAITS, str(turns))
        for line in said.splitlines():
            how, *values = line.split()
            rows.append([f"{how}, {busy} busy processes, run {i // 2 + 1}", *values])
    rows.sort(key=lambda row: row[0].split(", ")[1:])
    return [table(["lateness of a tick, us", "p50", "p99", "p99.9", "max"], rows)]


def measure_same_bits(options: Namespace, folder: Path) -> list[str]:
    rng = random.Random(options.seed)
    offline = simulate(load_scene("tilt_p10")).samples.tobytes()
    factors, equal = [0.0, 1.0, 10.0] * options.times, 0
    for i, factor in enumerate(factors):
        order = [x for name in rng.sample(NODES, 4) for x in (rng.uniform(0.0, 1.5), name)]
        with processes() as start:
            suite = Suite(start, folder / str(i), order, rtf=factor, scenes="[tilt_p10]")
            suite.end()
        equal += suite.recorded().samples.tobytes() == offline
    return [
        f"tilt_p10 at real-time factors {', '.join(f'{x:g}' for x in factors)}, nodes started in a "
        f"random order and up to 1.5 s apart: the samples of {equal} of {len(factors)} recordings "
        "are bit-identical to the offline run."
    ]


def measure_resets(options: Namespace, folder: Path) -> list[str]:
    steps, names = 20, NODES[:3]
    with processes() as start, closing(Client()) as client:
        nodes = [
            start(
                "simulator",
                wait_for="[launcher,capture_detector]",
                initial_state="stopped",
                scenes="[paper_designed]",
                exit_when_done="false",
            ),
            *(start(name) for name in names[1:]),
        ]
        for node in nodes[1:]:
            node.wait_for("ready")
        simulation = Simulation(client)
        assert simulation.set(State.PLAYING)[0] == Code.OK
        watched = [psutil.Process(node.process.pid) for node in nodes]
        states, memory, files, others = [], [], [], 0
        began = time.monotonic()
        for i in range(options.resets):
            wait_until(lambda: len(simulation.states) >= steps)
            bits = b"".join(
                np.array([m.t, *m.q, *m.v, m.energy_residual]).tobytes()
                for m in simulation.states[:steps]
            )
            states = states or [bits]
            others += bits != states[0]
            simulation.runs.clear()
            simulation.clock.clear()
            assert simulation.reset()[0] == Code.OK
            wait_until(lambda: simulation.runs)
            simulation.states.clear()
            if (i + 1) % max(options.resets // 4, 1) == 0:
                memory.append([p.memory_info().rss / 2**20 for p in watched])
                files.append([p.num_fds() for p in watched])
        each = (time.monotonic() - began) / options.resets
        simulation.set(State.QUITTING)
    rows = [
        [name, *(f"{m:.1f}, {f}" for m, f in zip(rss, fds, strict=True))]
        for name, rss, fds in zip(names, np.transpose(memory), np.transpose(files), strict=True)
    ]
    marks = [f"after {share} of the runs" for share in ("1/4", "1/2", "3/4", "all")[: len(memory)]]
    return [
        f"{options.resets} runs in one process, {steps} steps of paper_designed each and then a "
        f"reset: {others} of them differ from the first by a bit; each took {1e3 * each:.0f} ms.",
        "",
        table(["memory MB, open files", *marks], rows),
    ]


if __name__ == "__main__":
    write_parts(
        "node_suite",
        __doc__,
        {
            "start": measure_start,
            "paced": measure_paced,
            "busy": measure_busy,
            "waits": measure_waits,
            "unpaced": measure_unpaced,
            "same_bits": measure_same_bits,
            "resets": measure_resets,
        },
        seconds=(60.0, "of a paced or unpaced run"),
        times=(3, "that it is repeated"),
        suites=(20, "of two runs without pacing, beside two busy processes"),
        resets=(2000, "runs in one process"),
        seed=(1, "of the random moments"),
    )
