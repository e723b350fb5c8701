"""Trials of the example's rig over DDS: verdict, `detect`, loads, and what the recording holds.

    python -m benchmarks.rig_flows                        # about 3 minutes

Starts the real nodes and the bench of examples/, each in a process of its own; twelve goals of
launcher/run_trial.  Writes the table in docs/evidence/node_suite.md.
"""

from __future__ import annotations

import io
import re
import sys
from argparse import Namespace
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from benchmarks.pages import table, write_parts
from capture_sim.cli import main
from tests.nodes.bench_processes import Client, processes

sys.path.append(str(Path(__file__).parents[1] / "tests" / "nodes"))
from rig_session import POSES, Session

#: The topics of a driver that publishes Odometry, by the bench's names.
ODOMETRY = {"chaser/odom": "/mocap/rb1/odom", "target/odom": "/mocap/rb2/odom"}
OUTCOMES = ("captured", "rebound", "missed")
#: Benches by their name in the table: the topics of the poses, remappings, parameters.
BENCHES: dict[str, dict[str, Any]] = {
    "clean": {},
    "standard": {"preset": "standard"},
    "hard": {"preset": "hard"},
    "standard, best-effort Odometry": {
        "preset": "standard",
        "odometry": True,
        "best_effort": True,
    },
}


def detected(path: str, *options: str) -> str:
    """Return the verdict of `detect`, and whether it is the live one at the same time."""
    with redirect_stdout(io.StringIO()) as said:
        status = main(["detect", path, *options])
    (verdict,) = re.findall(r"verdict: (\w+) since", said.getvalue()) or ["none"]
    same = said.getvalue().rstrip().endswith("the same")
    return verdict if status == 0 and same else f"{verdict}, different"


def measure_trials(options: Namespace, folder: Path) -> list[str]:
    rows, wrong = [], 0
    for number, (name, bench) in enumerate(BENCHES.items()):
        is_odometry = bench.get("odometry", False)
        remaps = ODOMETRY if is_odometry else {}
        poses = [f"/{topic}" for topic in ODOMETRY] if is_odometry else POSES
        with processes() as start, Client() as client:
            session = Session(start, client, folder / str(number), poses=poses, **remaps)
            named = [word for pair in remaps.items() for word in ("--remap", ":=".join(pair))]
            listed = f"[{', '.join(OUTCOMES)}]"
            with session.bench(remaps, pace=options.pace, outcomes=listed, **bench):
                for outcome in OUTCOMES:
                    _, result = session.goal(expected=outcome).result()
                    found = detected(result.recording, *named) if result.recording else "none"
                    wrong += not (result.verdict == outcome == found and result.complete)
                    row = [name, outcome, result.verdict or result.reason, found]
                    row += ["yes" if result.complete else "; ".join(result.problems)]
                    row += [f"{result.impact_speed:.4f}", f"{result.max_force:.1f}"]
                    rows.append([*row, f"{1e3 * result.max_stroke:.2f}"])
    head = ["bench", "outcome", "verdict", "`detect`", "complete", "impact speed, m/s"]
    head += ["largest force, N", "stroke, mm"]
    good = f"{len(rows) - wrong} of {len(rows)} trials: the bench's outcome is the live verdict"
    rest = "and the verdict of `detect`, and the recording is complete."
    return [f"{good} {rest}", "", table(head, rows)]


if __name__ == "__main__":
    write_parts(
        "node_suite",
        __doc__,
        {"trials": measure_trials},
        untimed=("trials",),
        pace=(1.0, "s of the bench's clock in a second"),
    )
