"""A session of trials in a row, each with a random fault of a laboratory, by a seed.

    python -m benchmarks.trial_session [--trials 30] [--seed 1]

Faults: bodies that move before the release or jump in flight, sensors that die or stop in flight,
clocks that differ or step, a node that is killed or stands still, a second launcher, another
publisher of launcher/hold, a client that cancels.  The bench of examples/disturbed_rig.py knows how
each trial really ended.  Prints a line a trial, and how many moved unasked, were let go while a
body moved, had a wrong verdict without a named problem, another verdict on the topic than in the
result, or were unrecorded or incomplete without a word.
"""

from __future__ import annotations

import argparse
import math
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from std_msgs.msg import Bool

from capture_sim.messages.topics import HOLD
from capture_sim.nodes.base.endpoints import TRANSIENT_LOCAL
from tests.nodes.bench_client import Client
from tests.nodes.bench_processes import processes
from tests.nodes.forked import Forked
from tests.nodes.own_domain import own_domain

sys.path.append(str(Path(__file__).parents[1] / "tests" / "nodes"))
from rig_session import Goal, Session

LIMITS = {"start_timeout": 15.0, "closing_timeout": 15.0, "time_limit": 15.0, "max_pose_age": 1.0}
#: The bench of a trial with each fault: parameters of examples/disturbed_rig.py.
BENCHES = {
    "none": {"preset": "standard"},
    "hard sensors": {"preset": "hard"},
    "encoders die": {"encoder_end": 1.0},
    "cameras die": {"camera_end": 1.5},
    "encoders' clock": {"encoder_offset": 0.8},
}
#: Motions of chaser or target before the release: amplitude, m, and frequency, Hz.
SWINGS = ((0.004, 1.0), (0.008, 2.0), (0.02, 0.5), (0.03, 1.0), (0.05, 0.2))
MOVES = ("chaser swings", "target swings", "origin jumps")
IN_FLIGHT = (
    "stand recorder",
    "stand capture_detector",
    "kill recorder",
    "kill capture_detector",
    "second launcher",
    "foreign hold",
    "cancel",
)


def moving(chaser, fault: str, swing: tuple[float, float]):
    """Let the poses of a bench's chaser have a motion, by a class of its own."""
    amplitude, frequency = swing

    class Moving(type(chaser)):
        @property
        def poses(self):
            (x, y, yaw), (u, v, w) = super().poses
            wave = amplitude * math.sin(2.0 * math.pi * frequency * self.t)
            if fault == "chaser swings" and self.released is None:
                x += wave
            elif fault == "target swings" and self.released is None:
                v += wave
            elif fault == "origin jumps" and self.released is not None and self.going > 1.0:
                x += 0.3
            return (x, y, yaw), (u, v, w)

    chaser.__class__ = Moving


def await_phase(goal: Goal, phase: int) -> None:
    """Wait until a trial is in a phase or over."""
    while not goal.is_over and not any(f.phase >= phase for f in goal.feedback):
        time.sleep(0.005)


def one(start, client, session: Session, source: random.Random) -> tuple[str, str, str]:
    """Run a trial with a random fault; return the fault, the outcome, and what was wrong."""
    fault = source.choice([*BENCHES, *MOVES, *IN_FLIGHT])
    outcome = source.choice(["captured", "rebound", "missed"])
    parameters = {"loss": 0.0, "pace": 1.0, "rate": 50.0, "outcomes": f"[{outcome}]"}
    parameters |= BENCHES.get(fault, {"preset": "clean", "loss": 0.0})
    wrong, released = [], session.let_go
    with session.bench(**parameters) as bench:
        session.wait(1.0)
        if session.let_go != released or bench.chaser.released is not None:
            wrong.append("MOVED UNASKED")
        if fault in MOVES:
            moving(bench.chaser, fault, source.choice(SWINGS))
        del session.verdicts[:]
        goal, extra = Goal(session.actions, name=fault), None
        if fault in IN_FLIGHT:
            await_phase(goal, 1)
            time.sleep(source.uniform(0.0, 1.5))
            match fault.split():
                case ["stand", role]:
                    session.send_signal(role, signal.SIGSTOP)
                    time.sleep(2.0)
                    session.send_signal(role, signal.SIGCONT)
                case ["kill", role]:
                    session.kill(role)
                case ["second", _]:
                    extra = start("launcher", actuator="output", scene="tilt_0", __node="lab2")
                case ["foreign", _]:
                    extra = client.node.create_publisher(Bool, HOLD, TRANSIENT_LOCAL)
                case _:
                    goal.cancel()
        _, result = goal.result()
        problems = [*result.problems, *([result.reason] if "not released" in result.reason else [])]
        named = bool(problems) or result.verdict in ("", "undecided") or not result.complete
        if result.verdict not in ("", "undecided", outcome) and not named:
            wrong.append(f"WRONG VERDICT {result.verdict}, not {outcome}")
        if result.verdict and not result.recording and not result.problems:
            wrong.append("UNRECORDED WITHOUT A WORD")
        if fault in MOVES[:2] and session.let_go != released:
            wrong.append("LET GO WHILE A BODY MOVED")
        topic = next((label for label, is_final in session.verdicts[::-1] if is_final), "")
        is_reported = result.verdict and "capture_detector" not in fault
        if is_reported and topic != result.verdict:
            wrong.append(f"TOPIC {topic}")
        if fault == "stand recorder" and result.complete:
            wrong.append("COMPLETE WITH GAPS")
        if result.complete and result.problems:
            wrong.append("COMPLETE WITH PROBLEMS")
        session.wait(3.0)
        if bench.chaser.released is not None:
            wrong.append("NOT HELD AFTER THE TRIAL")
        if fault == "foreign hold" and extra is not None:
            client.node.destroy_publisher(extra)
        elif extra is not None:
            extra.end()
        if fault.startswith("kill"):
            session.restart(fault.removeprefix("kill "))
            time.sleep(13.0)  # DDS forgets the killed one
    text = f"{outcome}: {result.verdict or 'nothing released'}, {result.reason}; {problems}"
    return fault, text, ", ".join(wrong)


def main() -> None:
    """Run the session and count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    source, wrongs = random.Random(options.seed), Counter()
    with (
        tempfile.TemporaryDirectory() as folder,
        own_domain(),
        Client() as client,
        processes(Forked) as start,
    ):
        session = Session(start, client, Path(folder), launcher=LIMITS)
        for k in range(options.trials):
            fault, text, wrong = one(start, client, session, source)
            wrongs[wrong or "in order"] += 1
            print(f"{k + 1} {fault} | {text} | {wrong or 'in order'}", flush=True)
    print(dict(wrongs))


if __name__ == "__main__":
    main()
