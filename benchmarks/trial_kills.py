"""Kills in trials at random moments: what the result says, and is the next trial whole?

    python -m benchmarks.trial_kills --kills 200 [--seed 1] [--seconds 2400]

Launcher, detector and recorder serve the bench of examples/fake_rig.py.  In every round a random
node is killed (kill -9) at a random moment: before a goal, while a trial waits for its release, in
flight, after the verdict, or while it closes.  A simulator is killed in a run of its own before a
goal.  The node is started again at once, and the next trial is demanded through the action.  Prints
a table by moment: rounds, results that name the loss, next trials that were whole, and the longest
time from the kill to the next release.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path

from tests.nodes.bench_client import Client
from tests.nodes.bench_processes import processes
from tests.nodes.forked import Forked
from tests.nodes.own_domain import own_domain

sys.path.append(str(Path(__file__).parents[1] / "tests" / "nodes"))
from rig_session import SUCCEEDED, Goal, Session

ROLES = ("launcher", "recorder", "capture_detector")
MOMENTS = {"before": -1, "preparing": 0, "in flight": 1, "decided": 3, "closing": 4}
#: Pace and rate of the bench, slow enough for a busy machine.
BENCH = {"pace": 3.0, "rate": 30.0}
LIMITS = {"start_timeout": 40.0, "closing_timeout": 15.0, "time_limit": 60.0, "after_verdict": 0.3}
#: Only its clock is waived: a trial waits until the chaser of the one before has been pulled back.
LIMITS |= {"waive": "[machine_clock]"}


def await_goal(goal: Goal, limit: float) -> bool:
    """Wait for a goal's end; return False after ``limit`` s."""
    deadline = time.monotonic() + limit
    while not goal.is_over and time.monotonic() < deadline:
        time.sleep(0.02)
    return bool(goal.is_over)


def await_phase(goal: Goal, phase: int) -> None:
    while not goal.is_over and not any(f.phase >= phase for f in goal.feedback):
        time.sleep(0.002)


def kill_simulator(start, session: Session, source: random.Random) -> float:
    """Start a simulator, whose run detector and recorder join, and kill it in it."""
    simulator = start("simulator", rtf=1.0, exit_when_done="false")
    time.sleep(source.uniform(1.0, 5.0))
    simulator.process.kill()
    simulator.process.wait()
    return time.monotonic()


def one(start, session: Session, source: random.Random, k: int) -> dict[str, object]:
    """Kill one node, then demand a trial; return what was seen."""
    role = source.choice([*ROLES, *ROLES, "simulator"])
    moment = "before" if role == "simulator" else source.choice(list(MOMENTS))
    said, goal, times = "no trial", None, {}
    if moment != "before":
        goal = Goal(session.actions, name=f"killed {k}")
        await_phase(goal, MOMENTS[moment])
    time.sleep(source.uniform(0.0, {"in flight": 0.8, "preparing": 0.3}.get(moment, 0.2)))
    if role == "simulator":
        killed = kill_simulator(start, session, source)
    else:
        session.kill(role)
        killed = time.monotonic()
        if goal is not None and role != "launcher":
            if not await_goal(goal, 90.0):
                said = "no result"
            else:
                times["ended"] = round(time.monotonic() - killed, 1)
                _, result = goal.result()
                named = any(role in text for text in [*result.problems, result.reason])
                whole = result.complete and result.verdict and not result.problems
                said = "names it" if named else "whole" if whole else f"other: {result}"
        session.restart(role)
    times["started"] = round(time.monotonic() - killed, 1)
    goal = Goal(session.actions, name=f"next {k}")
    await_phase(goal, 1)
    waited = time.monotonic() - killed
    reasons = Counter(feedback.waiting_for for feedback in goal.feedback if feedback.waiting_for)
    times["waits"] = {text: round(0.1 * n, 1) for text, n in reasons.items()}  # feedback at 10 Hz
    if not await_goal(goal, 120.0):
        return {
            "role": role,
            "moment": moment,
            "said": said,
            "next": "no result",
            "waited": waited,
            **times,
        }
    status, result = goal.result()
    whole = status == SUCCEEDED and result.complete and result.verdict == "captured"
    after = "whole" if whole else f"{result.verdict} {result.reason} {list(result.problems)}"
    if not session.stamps or not session.holds[-1][1]:
        time.sleep(0.5)
    if not session.holds[-1][1]:
        after = "NOT HELD"
    return {"role": role, "moment": moment, "said": said, "next": after, "waited": waited, **times}


def main() -> None:
    """Kill, demand, count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after so long")
    options = parser.parse_args()
    source, begin = random.Random(options.seed), time.monotonic()
    rounds = []
    with (
        tempfile.TemporaryDirectory() as folder,
        own_domain(),
        Client() as client,
        processes(Forked) as start,
    ):
        session = Session(start, client, Path(folder), launcher=LIMITS)
        with session.bench(is_disturbed=False, **BENCH):
            k = 0
            while k < options.kills and time.monotonic() < begin + options.seconds:
                k += 1
                rounds.append(found := one(start, session, source, k))
                print(k, found, flush=True)
    print_table(rounds)


def print_table(rounds: list[dict[str, object]]) -> None:
    """Print what was seen, by role and moment."""
    by_row = defaultdict(list)
    for found in rounds:
        by_row[found["role"], found["moment"]].append(found)
    print("| node | moment | kills | result | next trial whole | longest wait, s |")
    print("|---|---|---|---|---|---|")
    for (role, moment), row in sorted(by_row.items()):
        said = Counter(str(each["said"]).split(":")[0] for each in row)
        text = ", ".join(f"{n} {what}" for what, n in said.items())
        whole = sum(each["next"] == "whole" for each in row)
        longest = max(float(str(each["waited"])) for each in row)
        print(f"| {role} | {moment} | {len(row)} | {text} | {whole} | {longest:.1f} |")
    whole = sum(each["next"] == "whole" for each in rounds)
    print(f"{len(rounds)} kills; {whole} next trials whole")


if __name__ == "__main__":
    main()
