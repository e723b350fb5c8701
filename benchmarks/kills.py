"""Kills (`kill -9`) of a random node at a random moment: what is kept, and does the next one work?

    python -m benchmarks.kills                                  # all parts, a quarter of an hour
    python -m benchmarks.kills killed_trials --kills 200 --seconds 2400

In a run (``kills``), before the next start of a suite (``killed_starts``), and in trials of the
bench of examples/fake_rig.py (``killed_trials``); writes the parts of docs/evidence/node_suite.md.
"""

from __future__ import annotations

import random
import sys
import time
from argparse import Namespace
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.node_suite import NODES, Suite
from benchmarks.pages import table, write_parts
from capture_sim import load_scene, simulate
from tests.nodes.bench_client import Client
from tests.nodes.bench_processes import Simulation, processes
from tests.nodes.forked import Forked
from tests.nodes.own_domain import own_domain

sys.path.append(str(Path(__file__).parents[1] / "tests" / "nodes"))
from rig_session import SUCCEEDED, Goal, Session

#: A node is killed this long after its start at most, s.
LATEST = 3.0
#: A suite, or a trial, that has not ended by then is stuck, s.
LIMIT = 120.0
ROLES = ("launcher", "recorder", "capture_detector")
#: Moments of a trial, by the phase of its feedback.
MOMENTS = {"before": -1, "preparing": 0, "in flight": 1, "decided": 3, "closing": 4}
#: Pace and rate of the bench, slow enough for a busy machine.
BENCH = {"pace": 3.0, "rate": 30.0}
LIMITS = {"start_timeout": 40.0, "closing_timeout": 15.0, "time_limit": 60.0, "after_verdict": 0.3}
#: Only its clock is waived: a trial waits until the chaser of the one before has been pulled back.
LIMITS |= {"waive": "[machine_clock]"}


class Kill(NamedTuple):
    """What was seen of one kill: of whom, when, what was said of it, and what followed."""

    victim: str
    moment: str
    said: str
    next: str  # "whole", or what was wrong
    waited: float  # from the kill to what is demanded next, s


def kills(options: Namespace, one: Callable[[int, random.Random], Kill]) -> Iterator[Kill]:
    """Kill as often, and for as long, as asked."""
    source, begin = random.Random(options.seed), time.monotonic()
    for number in range(options.kills):
        if options.seconds and time.monotonic() > begin + options.seconds:
            return
        found = one(number, source)
        print(number, found, file=sys.stderr, flush=True)
        yield found


def shown(found: list[Kill], what: str) -> list[str]:
    """Return a table of kills by node and moment, and how many of what was demanded were whole."""
    groups = defaultdict(list)
    for kill in found:
        groups[kill.victim, kill.moment].append(kill)
    rows = []
    for (victim, moment), group in sorted(groups.items()):
        said = Counter(kill.said.split(":")[0] for kill in group)
        text = ", ".join(f"{n} {words}" for words, n in said.items())
        whole = sum(kill.next == "whole" for kill in group)
        rows.append(
            [victim, moment, len(group), text, whole, f"{max(k.waited for k in group):.1f}"]
        )
    others = [f"- {kill}" for kill in found if kill.next != "whole"]
    whole = len(found) - len(others)
    head = ["node", "moment", "kills", "result", f"{what} whole", "longest wait, s"]
    return [f"{len(found)} kills; {what} whole: {whole}.", "", table(head, rows), *others]


def in_run(offline: Any, folder: Path, number: int, source: random.Random) -> Kill:
    """Kill a node of a run at twice real time; all others must end in order, the rest is kept."""
    victim, delay = source.choice(NODES), source.uniform(0.0, 2.5)
    problems, lost = [], 0.0
    with processes(Forked) as start, closing(Client()) as client:
        simulation = Simulation(client)
        suite = Suite(start, folder / f"kill_{number}", rtf=2.0)
        suite.nodes["simulator"].wait_for("released")
        time.sleep(delay)
        suite.nodes[victim].process.kill()
        killed, sent = time.monotonic(), len(simulation.states)
        if victim == "simulator":
            suite.nodes["recorder"].wait_for(".mcap: ")  # DDS notices after 6 s
        else:
            suite.nodes["simulator"].status()
        for name in set(suite.nodes) - {victim}:
            # a launcher that dies after the release is missed by nobody
            node = suite.nodes[name]
            ended = node.end(), "Traceback" in node.text
            if ended not in ((0, False), (1, False)):
                problems.append(f"{name} ended with {ended}")
        waited = time.monotonic() - killed
        if victim != "simulator" and "done, " not in suite.nodes["simulator"].text:
            problems.append("the run did not go on")
    run = suite.recorded()
    kept = 0 if run is None else run.samples.size
    if kept and run.samples.tobytes() != offline[:kept].tobytes():
        problems.append("other bits in the recording")
    if victim == "recorder":
        lost = max(sent - kept, 0) / 2.0  # ms of wall time, at 1 kHz and rtf 2
    return Kill(victim, "in a run", f"{lost:.0f} ms lost", "; ".join(problems) or "whole", waited)


def before_start(folder: Path, number: int, source: random.Random) -> Kill:
    """Kill a node after its start, others with it, and demand a run of a suite started at once."""
    with processes(Forked) as start:
        suite = Suite(start, folder / f"killed_{number}", rtf=2.0)
        victim = source.choice(NODES)
        time.sleep(source.uniform(0.0, LATEST))
        suite.nodes.pop(victim).process.kill()
        for node in suite.nodes.values():
            if source.random() < 0.5:
                node.process.kill()
    killed = time.monotonic()
    with processes(Forked) as start:
        suite = Suite(start, folder / f"run_{number}", rtf=0.0)
        simulator = suite.nodes["simulator"].process
        while simulator.poll() is None and time.monotonic() < killed + LIMIT:
            time.sleep(0.1)
        is_whole = simulator.poll() == 0 and suite.nodes["recorder"].end() == 0
        is_whole = is_whole and suite.recorded().complete
    said = "whole" if is_whole else suite.nodes["simulator"].text
    return Kill(victim, "since its start", "no run", said, time.monotonic() - killed)


def await_goal(goal: Goal, limit: float) -> bool:
    """Wait for a goal's end; return False after ``limit`` s."""
    deadline = time.monotonic() + limit
    while not goal.is_over and time.monotonic() < deadline:
        time.sleep(0.02)
    return bool(goal.is_over)


def await_phase(goal: Goal, phase: int) -> None:
    while not goal.is_over and not any(f.phase >= phase for f in goal.feedback):
        time.sleep(0.002)


def kill_simulator(start: Callable[..., Any], source: random.Random) -> float:
    """Start a simulator, whose run detector and recorder join, and kill it in it."""
    simulator = start("simulator", rtf=1.0, exit_when_done="false")
    time.sleep(source.uniform(1.0, 5.0))
    simulator.process.kill()
    simulator.process.wait()
    return time.monotonic()


def in_trial(
    start: Callable[..., Any], session: Session, number: int, source: random.Random
) -> Kill:
    """Kill a node of a trial, or a simulator before it; start the node again, demand a trial."""
    victim = source.choice([*ROLES, *ROLES, "simulator"])
    moment = "before" if victim == "simulator" else source.choice(list(MOMENTS))
    said, goal = "no trial", None
    if moment != "before":
        goal = Goal(session.actions, name=f"killed {number}")
        await_phase(goal, MOMENTS[moment])
    time.sleep(source.uniform(0.0, {"in flight": 0.8, "preparing": 0.3}.get(moment, 0.2)))
    if victim == "simulator":
        killed = kill_simulator(start, source)
    else:
        session.kill(victim)
        killed = time.monotonic()
        if goal is not None and victim != "launcher":
            said = said_of(goal, victim)
        session.restart(victim)
    goal = Goal(session.actions, name=f"next {number}")
    await_phase(goal, 1)
    seen = partial(Kill, victim, moment, said, waited=time.monotonic() - killed)
    if not await_goal(goal, LIMIT):
        return seen("no result")
    status, result = goal.result()
    whole = status == SUCCEEDED and result.complete and result.verdict == "captured"
    after = "whole" if whole else f"{result.verdict} {result.reason} {list(result.problems)}"
    if not session.stamps or not session.holds[-1][1]:
        time.sleep(0.5)
    return seen(after if session.holds[-1][1] else "NOT HELD")


def said_of(goal: Goal, victim: str) -> str:
    """Return what the result of a trial says of the node that was killed in it."""
    if not await_goal(goal, LIMIT):
        return "no result"
    _, result = goal.result()
    if any(victim in text for text in [*result.problems, result.reason]):
        return "names it"
    is_whole = result.complete and result.verdict and not result.problems
    return "whole" if is_whole else f"other: {result}"


def measure_runs(options: Namespace, folder: Path) -> list[str]:
    offline = simulate(load_scene("tilt_0")).samples
    return shown(list(kills(options, partial(in_run, offline, folder))), "others")


def measure_starts(options: Namespace, folder: Path) -> list[str]:
    def leftovers() -> int:
        return len(list(Path("/dev/shm").glob("*fast*")))

    before = leftovers()
    lines = shown(list(kills(options, partial(before_start, folder))), "next runs")
    return [*lines, "", f"Files of Fast DDS in /dev/shm: {before} before, {leftovers()} after."]


def measure_trials(options: Namespace, folder: Path) -> list[str]:
    with own_domain(), Client() as client, processes(Forked) as start:
        session = Session(start, client, folder, launcher=LIMITS)
        with session.bench(is_disturbed=False, **BENCH):
            found = list(kills(options, partial(in_trial, start, session)))
    return shown(found, "next trials")


if __name__ == "__main__":
    parts = {
        "kills": measure_runs,
        "killed_starts": measure_starts,
        "killed_trials": measure_trials,
    }
    write_parts(
        "node_suite",
        __doc__,
        parts,
        untimed=set(parts),
        kills=(20, "of each part"),
        seed=(1, "of the random moments"),
        seconds=(0.0, "after which a part makes no further kill; 0: none"),
    )
