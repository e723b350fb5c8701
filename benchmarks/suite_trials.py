"""The trials of node_suite.py: each has TITLE, run(folder, options) and lines(figures)."""

import hashlib
import os
import random
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
from bench_processes import Client, Simulation, processes, wait_until

from benchmarks.machine import load
from capture_sim import load_scene, simulate
from capture_sim.control.simulation import Code, State
from capture_sim.recording.read import read_run

FOLLOWERS = ("launcher", "capture_detector", "recorder")
NODES = ("simulator", *FOLLOWERS)
#: 1 kHz of state and 100 Hz of the rest without end: nothing latches.
LONG = ["latch=null"]

BARE = """
import sys, time
n, period = int(sys.argv[1]), 1e-3
late = []
start = time.monotonic()
for i in range(n):
    due = start + i * period
    delay = due - time.monotonic()
    if delay > 0.0:
        time.sleep(delay)
    late.append(time.monotonic() - due)
print(*late)
"""


def settings():
    """Keep apart from everything else on the machine."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


def start_all(start, out, order=NODES, **simulator):
    """Start the whole bench in an order; return the nodes by name."""
    given = {"simulator": simulator, "recorder": {"out": out}}
    return {name: start(name, **given.get(name, {})) for name in order}


def hashed(run):
    """Return a hash of the state stream's bytes."""
    return hashlib.sha256(b"".join(run.raw("bench/state"))).hexdigest()[:16]


def row(*cells):
    """Return a row of a Markdown table."""
    first, rest = cells
    return f"| {first} | " + " | ".join(map(str, rest)) + " |"


class Paced:
    """1 kHz of state, 100 Hz of everything else, in real time."""

    TITLE = "Real time: 1 kHz state, 100 Hz standard topics"

    TIMES = 3

    @classmethod
    def run(cls, folder, options):
        runs = [cls._once(folder / str(i), options.seconds) for i in range(cls.TIMES)]
        return {"seconds": options.seconds, "runs": runs, "load": load()}

    @staticmethod
    def _once(folder, seconds):
        folder.mkdir()
        overrides = str([*LONG, f"run.t_end={seconds}"])
        with processes(folder) as start:
            nodes = start_all(start, folder / "out", rtf=1.0, overrides=overrides)
            nodes["simulator"].wait_for("released")
            command = [sys.executable, "-c", BARE, str(int(1000 * seconds))]
            bare = subprocess.run(command, capture_output=True, text=True, check=True)
            status = {name: node.status(120.0) for name, node in nodes.items()}
            said = nodes["simulator"].text
        late = np.percentile([float(x) for x in bare.stdout.split()], [50, 99, 99.9, 100])
        done = re.search(r"done, .*\(([\d.]+) x .* late by ([\d, -]+) us", said)
        run = read_run(folder / "out" / "tilt_0.mcap")
        return {
            "factor": float(done[1]),
            "ticks_us": [int(x) for x in done[2].split(",")],
            "bare_us": [round(1e6 * x) for x in late],
            "messages": sum(run.topics.values()),
            "complete": bool(run.complete),
            "status": status,
        }

    @staticmethod
    def lines(f):
        runs = f["runs"]
        ticks, bare = (np.array([run[k] for run in runs]) for k in ("ticks_us", "bare_us"))
        complete = all(run["complete"] for run in runs)
        factors = ", ".join(f"{run['factor']:.5f}" for run in runs)
        return [
            f"{len(runs)} times {f['seconds']:g} s with launcher, detector and recorder: "
            f"{runs[0]['messages']} messages recorded each, "
            f"{'none lost' if complete else 'NOT ALL'}; real-time factors {factors}.",
            "",
            "| lateness of a tick, us | p50 | p99 | p99.9 | max |",
            "|---|---|---|---|---|",
            *(row(f"simulator, run {i}", late.tolist()) for i, late in enumerate(ticks, 1)),
            *(
                row(f"a bare sleep loop beside it, run {i}", x.tolist())
                for i, x in enumerate(bare, 1)
            ),
            row("ratio, median of the runs", [f"{r:.2f}" for r in np.median(ticks / bare, axis=0)]),
        ]


class Unpaced:
    """The same rates, as fast as it goes."""

    TITLE = "As fast as it goes, at the same rates"

    @staticmethod
    def run(folder, options):
        seconds = max(options.seconds, 10.0)
        overrides = str([*LONG, f"run.t_end={seconds}"])
        factors, complete, spent = [], True, {}
        for i in range(3):
            with processes(folder) as start:
                out = folder / str(i)
                nodes = start_all(start, out, overrides=overrides)
                watched = {n: psutil.Process(node.process.pid) for n, node in nodes.items()}
                nodes["simulator"].wait_for("released")
                before = {n: sum(p.cpu_times()[:2]) for n, p in watched.items()}
                while "done, " not in nodes["simulator"].text:
                    for n, p in watched.items():
                        if nodes[n].process.poll() is None:
                            spent[n] = round(sum(p.cpu_times()[:2]) - before[n], 2)
                    time.sleep(0.05)
                assert not any(node.status() for node in nodes.values())
                found = re.search(r"done, .*\(([\d.]+) x", nodes["simulator"].text)
                factors.append(float(found[1]))
                complete = complete and read_run(out / "tilt_0.mcap").complete
        return {
            "seconds": seconds,
            "factors": factors,
            "complete": bool(complete),
            "cpu": spent,
            "load": load(),
        }

    @staticmethod
    def lines(f):
        cpu = ", ".join(f"{name} {value:g}" for name, value in f["cpu"].items())
        return [
            f"{f['seconds']:g} simulated seconds, three times: "
            + ", ".join(f"{x:.1f}" for x in f["factors"])
            + f" times real time, {'nothing lost' if f['complete'] else 'NOT COMPLETE'}.",
            f"CPU time of the nodes in the last of them, s: {cpu}.",
        ]


class SameBits:
    """Real-time factors and orders of start."""

    TITLE = "Same bits"

    @staticmethod
    def run(folder, options):
        rng = random.Random(options.seed)
        offline = simulate(load_scene("tilt_p10")).samples
        cases, hashes, same = [], set(), True
        for i, pace in enumerate([0.0, 1.0, 10.0, 0.0, 0.0, 10.0]):
            order = list(NODES)
            rng.shuffle(order)
            with processes(folder) as start:
                out = folder / str(i)
                nodes = {}
                for name in order:
                    given = {"simulator": {"rtf": pace, "scenes": "[tilt_p10]"}}
                    given["recorder"] = {"out": out}
                    nodes[name] = start(name, **given.get(name, {}))
                    time.sleep(rng.uniform(0.0, 1.5))
                assert not any(node.status() for node in nodes.values())
                run = read_run(out / "tilt_p10.mcap")
            hashes.add(hashed(run))
            same = same and run.samples.tobytes() == offline.tobytes()
            cases.append([pace, order])
        return {"cases": cases, "hashes": sorted(hashes), "offline": same, "load": load()}

    @staticmethod
    def lines(f):
        paces = ", ".join(f"{case[0]:g}" for case in f["cases"])
        return [
            f"tilt_p10 at real-time factors {paces}, nodes started in a random order and up to "
            f"1.5 s apart: {len(f['hashes'])} different state stream(s) "
            f"({', '.join(f['hashes'])}), {'equal' if f['offline'] else 'NOT EQUAL'} to the "
            "offline run's samples bit for bit.",
        ]


class Resets:
    """Reset, step, reset, step ..."""

    TITLE = "Resets"
    STEPS = 20
    NODES = ("simulator", "launcher", "capture_detector")
    #: Until then the latched histories fill up: 1000 messages each of log and events.
    FILLED = 1000

    @staticmethod
    def run(folder, options):
        with processes(folder) as start, Client() as client:
            node = start(
                "simulator",
                consumers="[launcher,capture_detector]",
                initial_state="stopped",
                exit_when_done="false",
                scenes="[paper_designed]",
            )
            nodes = [node, *(start(name, exit_when_done="false") for name in Resets.NODES[1:])]
            simulation = Simulation(client)
            watched = [psutil.Process(node.process.pid) for node in nodes]
            for follower in nodes[1:]:
                follower.wait_for("ready")
            assert simulation.set(State.PAUSED)[0] == Code.OK
            memory, files, differing = [], [], 0
            reference = None
            began = time.monotonic()
            for i in range(options.resets):
                simulation.states.clear()
                assert simulation.step(Resets.STEPS)[0] == Code.OK
                wait_until(lambda: len(simulation.states) == Resets.STEPS)
                got = b"".join(
                    np.array([m.t, *m.q, *m.v, m.energy_residual]).tobytes()
                    for m in simulation.states
                )
                reference = got if reference is None else reference
                differing += got != reference
                for kept in (simulation.runs, simulation.clock):
                    kept.clear()
                assert simulation.reset()[0] == Code.OK
                if i % 50 == 49:
                    memory.append([p.memory_info().rss / 2**20 for p in watched])
                    files.append(watched[0].num_fds())
            spent = time.monotonic() - began
            simulation.set(State.QUITTING)
            node.status(20.0)
        by_node = dict(zip(Resets.NODES, zip(*memory, strict=True), strict=True))
        return {
            "resets": options.resets,
            "differing": differing,
            "each_ms": 1e3 * spent / options.resets,
            "rss_mb": {name: [round(m, 2) for m in rss] for name, rss in by_node.items()},
            "fds": [files[0], files[-1]],
            "load": load(),
        }

    @staticmethod
    def lines(f):
        count = len(f["rss_mb"]["simulator"])
        filled = Resets.FILLED // 50 - 1
        places = sorted({0, min(filled, count - 1), count // 2, count - 1})
        marks = [50 * (i + 1) for i in places]
        return [
            f"{f['resets']} resets, each followed by {Resets.STEPS} steps of paper_designed: "
            f"{f['differing']} of them differ from the first in a bit. The simulator's open files: "
            f"{f['fds'][0]} at the 50th, {f['fds'][1]} at the last. A reset with its steps took "
            f"{f['each_ms']:.0f} ms.",
            "",
            "| memory, MB | " + " | ".join(f"at the {at}th" for at in marks) + " | since the "
            f"{marks[1]}th |",
            "|---" * (len(marks) + 2) + "|",
            *(
                row(
                    name,
                    [*(f"{rss[i]:.2f}" for i in places), f"{rss[-1] - rss[places[1]]:+.2f}"],
                )
                for name, rss in f["rss_mb"].items()
            ),
            "",
            "What grows before are pools that fill up: up to 1000 messages a topic that DDS keeps "
            "for latecomers (the log is full after 400 resets, the events, one a reset here, "
            "after 1000), and those of the allocators.",
        ]


class Latency:
    """From the simulator's send to the detector's callback, and to its verdict sent."""

    TITLE = "Latency from simulator to detector"
    SENDER = """
        import atexit, struct, time
        from capture_sim.messages.topics import BUFFER_STATE, TARGET_ODOMETRY, CAPTURE_STATUS
        watched = {{BUFFER_STATE: [], TARGET_ODOMETRY: [], CAPTURE_STATUS: []}}
        send = node.{cls}.send
        def stamp_of(message):
            if isinstance(message, bytes):
                sec, nanosec = struct.unpack_from("<iI", message, 4)
                return sec * 10**9 + nanosec
            return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        def timed(self, topic, message):
            if topic in watched:
                watched[topic].append((stamp_of(message), time.monotonic()))
            send(self, topic, message)
        node.{cls}.send = timed
        take = getattr(node.{cls}, "_take", None)
        taken = []
        def took(self, topic, data):
            taken.append((topic.name, stamp_of(data), time.monotonic()))
            take(self, topic, data)
        if take is not None:
            node.{cls}._take = took
        def save():
            import json
            kept = {{topic.name: times for topic, times in watched.items()}}
            with open({path!r}, "w") as file:
                json.dump([kept, taken], file)
        atexit.register(save)
    """

    @staticmethod
    def run(folder, options):
        import json

        seconds = min(options.seconds, 20.0)
        overrides = str([*LONG, f"run.t_end={seconds}"])
        paths = {name: str(folder / f"{name}.json") for name in ("simulator", "detector")}
        with processes(folder) as start:
            sender = Latency.SENDER.format(cls="SimulatorNode", path=paths["simulator"])
            taker = Latency.SENDER.format(cls="CaptureDetectorNode", path=paths["detector"])
            nodes = [
                start("simulator", sender, rtf=1.0, overrides=overrides),
                start("capture_detector", taker),
                start("launcher"),
                start("recorder", out=folder / "out"),
            ]
            assert not any(node.status(120.0) for node in nodes)
        (sent, _), (judged, taken) = (json.loads(Path(p).read_text()) for p in paths.values())
        odometry = dict(map(tuple, sent["target/odom"]))
        came = {stamp: t for name, stamp, t in taken if name == "target/odom"}
        verdicts = dict(map(tuple, judged["capture/status"]))
        transport = [1e6 * (came[s] - odometry[s]) for s in odometry if s in came]
        # the detector judges when the last message of a stamp is there
        whole = [1e6 * (verdicts[s] - odometry[s]) for s in odometry if s in verdicts]
        return {
            "seconds": seconds,
            "count": len(transport),
            "transport_us": [round(x) for x in np.percentile(transport, [50, 99, 100])],
            "verdict_us": [round(x) for x in np.percentile(whole, [50, 99, 100])],
            "load": load(),
        }

    @staticmethod
    def lines(f):
        return [
            f"{f['count']} samples in {f['seconds']:g} s of real time, all nodes running, one "
            "steady clock for both processes.",
            "",
            "| us | p50 | p99 | max |",
            "|---|---|---|---|",
            "| target/odom sent to its callback | "
            + " | ".join(map(str, f["transport_us"]))
            + " |",
            "| target/odom sent to capture/status sent | "
            + " | ".join(map(str, f["verdict_us"]))
            + " |",
        ]


class Kills:
    """kill -9 of any node at random moments."""

    TITLE = "Killed nodes"

    @staticmethod
    def run(folder, options):
        rng = random.Random(options.seed)
        offline = simulate(load_scene("tilt_0")).samples
        trials, problems = [], []
        with processes(folder) as start:
            bench = _LastingBench(start, folder / "out")
            for number in range(options.kills):
                victim = rng.choice(NODES)
                delay = rng.uniform(0.0, 3.5)
                trial = bench.trial(victim, delay, offline)
                trials.append(trial)
                print(f"{number}: {trial}", flush=True)
                problems += [f"trial {number}, {victim}: {p}" for p in trial["problems"]]
        lost = [t["lost_ms"] for t in trials if t["lost_ms"] is not None]
        count = {name: sum(t["victim"] == name for t in trials) for name in NODES}
        return {
            "kills": len(trials),
            "by_node": count,
            "problems": problems,
            "most_lost_ms": max(lost, default=0.0),
            "recorder_killed_in_a_run": len(lost),
            "load": load(),
        }

    @staticmethod
    def lines(f):
        count = ", ".join(f"{name} {n}" for name, n in f["by_node"].items())
        lines = [
            f"{f['kills']} times `kill -9` at a random moment ({count}), real-time factor 2. "
            "After each: the others are alive and without traceback, what is recorded equals the "
            "offline run bit for bit, the node is started again, and a whole run with it is "
            "complete.",
            "",
            f"A killed recorder ({f['recorder_killed_in_a_run']} times within a run) lost at "
            f"most the last {f['most_lost_ms']:.0f} ms of wall time.",
            "",
        ]
        lines += [f"- {' '.join(p.split())}" for p in f["problems"]] or ["Nothing else was seen."]
        return lines


class _LastingBench:
    """Nodes that stay; the dead are replaced."""

    def __init__(self, start, out):
        self._start = start
        self._out = out
        self._parameters = {
            "simulator": {"initial_state": "stopped", "rtf": 2.0, "consumer_timeout": 1.0},
            "recorder": {"out": out, "drain_timeout": 1.0},
        }
        self.nodes = {name: self._new(name) for name in NODES}
        self._meet()
        for name in FOLLOWERS:
            self.nodes[name].wait_for("ready")

    def _meet(self):
        """Talk to the simulator; anew to a new one: DDS keeps the dead one's services for 20 s."""
        self.simulation = Simulation(Client())

    def _new(self, name):
        return self._start(name, exit_when_done="false", **self._parameters.get(name, {}))

    def trial(self, victim, delay, offline):
        problems = []
        marks = {name: len(node.lines) for name, node in self.nodes.items()}
        self.simulation.states.clear()
        self.simulation.set(State.PLAYING)
        time.sleep(delay)
        sent = [m.t for m in self.simulation.states]
        dead = self.nodes[victim]
        dead.process.kill()
        dead.process.wait()
        recorded = self._newest()
        others = {name: node for name, node in self.nodes.items() if name != victim}
        if victim == "simulator":
            armed = "armed" in "".join(others["launcher"].lines[marks["launcher"] :])
            over = "done, " in "".join(dead.lines[marks["simulator"] :])
            for name in FOLLOWERS if armed and not over else ():
                others[name].wait_for("has gone", 10.0, since=marks[name])
        elif victim != "launcher" or sent:
            wait_until(lambda: self.simulation.state is State.STOPPED, 30.0, "did not stop")
        lost = None
        if victim == "recorder" and sent:
            kept = self._prefix(recorded, offline, problems)
            lost = round(max(1e3 * (sent[-1] - kept / 1000.0) / 2.0, 0.0), 1)
        elif recorded is not None and sent:
            time.sleep(0.3)
            self._prefix(recorded, offline, problems)
        for name, node in others.items():
            if node.process.poll() is not None:
                problems.append(f"{name} ended with {node.process.returncode}")
            if "Traceback" in node.text:
                problems.append(f"{name}: traceback")
        self.nodes[victim] = self._new(victim)
        if victim == "simulator":
            self.simulation.client.close()
            self._meet()
        else:
            self.nodes[victim].wait_for("ready")
        self._whole_run(victim, offline, problems)
        return {
            "victim": victim,
            "delay": round(delay, 2),
            "sent": len(sent),
            "lost_ms": lost,
            "problems": problems,
        }

    def _whole_run(self, victim, offline, problems):
        """Run once more with all nodes; it must be complete."""
        if victim == "launcher" and self.simulation.state is not State.STOPPED:
            wait_until(lambda: self.simulation.state is State.STOPPED, 60.0, "did not go on")
        mark = len(self.nodes["recorder"].lines)
        # after a death DDS may need some moments until every subscription has found its peer
        self.simulation.set(State.PLAYING)
        wait_until(lambda: self.simulation.state is State.STOPPED, 60.0, "whole run: not over")
        try:
            self.nodes["recorder"].wait_for("messages, ", 20.0, since=mark)
        except AssertionError:
            problems.append("recorder did not close the whole run")
            return
        said = "".join(self.nodes["recorder"].lines[mark:])
        if "messages, complete" not in said:
            # what was said last, without where and when
            last = [line.split(": ", 2)[-1] for line in said.splitlines() if "[ERROR]" in line]
            problems.append(f"the run after it is not complete: {'; '.join(last[-2:])}")
            return
        run = read_run(self._newest())
        if run.samples.tobytes() != offline.tobytes():
            problems.append("the run after it has other bits")

    def _newest(self):
        files = sorted(self._out.glob("**/*.mcap"), key=lambda path: path.stat().st_mtime)
        return files[-1] if files else None

    def _prefix(self, path, offline, problems):
        """Return how many samples a recording holds; they must be the run's first."""
        kept = read_run(path).samples
        if kept.tobytes() != offline[: kept.size].tobytes():
            problems.append("what is recorded differs from the run")
        return kept.size


PARTS = {
    "paced": Paced,
    "unpaced": Unpaced,
    "same_bits": SameBits,
    "resets": Resets,
    "latency": Latency,
    "kills": Kills,
}
