"""Error rates of the capture detector on noisy replays; writes them into docs/detection.md.

    .venv/bin/python -m benchmarks.detection

Takes about eight minutes.  `--replays 10` for a look.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from capture_sim import load_scene, simulate
from tests.noisy_replay import Disturbance, disturbed, judge

PAGE = Path(__file__).resolve().parent.parent / "docs" / "detection.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"

#: What is replayed: scene, changes, and what it is called.
CASES = (
    ("tilt_0", (), "tilt_0"),
    ("tilt_p10", (), "tilt_p10"),
    ("tilt_m10", (), "tilt_m10"),
    ("paper_designed", (), "paper_designed"),
    ("paper_case_2", (), "paper_case_2"),
    ("paper_undamped", (), "paper_undamped"),
    ("paper_case_1", (), "paper_case_1"),
    ("paper_clamped", (), "paper_clamped"),
    ("paper_case_3", (), "paper_case_3"),
    (
        "paper_designed",
        ("initial.target.x=0.55", "initial.target.y=0.09"),
        "passes 8 mm beside the lip",
    ),
    (
        "paper_designed",
        ("initial.target.x=0.55", "initial.target.y=-0.085"),
        "passes 3 mm beside the lip",
    ),
    ("paper_designed", ("initial.target.x=0.7", "run.t_end=1.5"), "ends 42 mm before the cone"),
    ("tilt_p10", ("latch=null", "string.impact_speed=0.04"), "tilt_p10 at 0.04 m/s, no latch"),
)

STANDARD = Disturbance()
SWEEP = {
    "no disturbance": Disturbance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "half the noise": dataclasses.replace(STANDARD, position=0.5e-3, angle=math.radians(0.1)),
    "twice the noise": dataclasses.replace(STANDARD, position=2e-3, angle=math.radians(0.4)),
    "three times the noise": dataclasses.replace(STANDARD, position=3e-3, angle=math.radians(0.6)),
    "buffer measured as badly as the poses": dataclasses.replace(
        STANDARD, stroke=1e-3, torsion=math.radians(0.2)
    ),
    "25 % lost": dataclasses.replace(STANDARD, loss=0.25),
    "50 ms jitter": dataclasses.replace(STANDARD, jitter=0.05),
    "sources at 50 Hz": STANDARD,
    "sources at 200 Hz": STANDARD,
}


class Outcome(NamedTuple):
    """What the replays of a run gave."""

    verdict: str
    wrong: int
    replays: int
    delays: list[float]  # s, later than without noise


def replay(result, name, how, replays, rate=100.0):
    """Judge a run many times over, each time with other noise."""
    verdict = result.verdict
    decided = next((s.t for s in result.statuses if s.final), result.t[-1])
    wrong, delays = 0, []
    for k in range(replays):
        rng = np.random.default_rng([zlib.crc32(name.encode()), k])
        last, t = judge(result.scene, disturbed(result, how, rng, rate))
        wrong += last.state is not verdict
        delays.append(t - decided)
    return Outcome(verdict.label, wrong, replays, delays)


def at_most(wrong, replays):
    """Return the upper end of the 95 % interval of an error rate (Clopper and Pearson 1934)."""
    low, high = wrong / replays, 1.0
    for _ in range(60):
        p = 0.5 * (low + high)
        below = sum(
            math.comb(replays, i) * p**i * (1 - p) ** (replays - i) for i in range(wrong + 1)
        )
        low, high = (p, high) if below > 0.05 else (low, p)
    return high


def main():
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replays", type=int, default=340, help="of each run, standard noise")
    parser.add_argument("--sweep", type=int, default=20, help="of each run, other disturbances")
    parser.add_argument("--dry", action="store_true", help="show, do not write")
    asked = parser.parse_args()
    runs = [(name, simulate(load_scene(scene, changes))) for scene, changes, name in CASES]
    lines = [
        f"{asked.replays} replays of each run, every one with other noise:",
        "",
        "| run | verdict | nearest mm | wrong | later by s: median | worst |",
        "|---|---|---|---|---|---|",
    ]
    by_class: dict[str, list[int]] = {}
    for name, result in runs:
        got = replay(result, name, STANDARD, asked.replays)
        nearest = result.samples["tip_distance"].min() * 1e3
        lines.append(
            f"| {name} | {got.verdict} | {nearest:.2f} | {got.wrong} of {got.replays} "
            f"| {np.median(got.delays):.2f} | {max(got.delays):.2f} |"
        )
        print(lines[-1], flush=True)
        total = by_class.setdefault(got.verdict, [0, 0])
        total[0] += got.wrong
        total[1] += got.replays
    lines += ["", "By verdict (95 % bound of Clopper and Pearson on the error rate):", ""]
    lines += [
        f"- {verdict}: {wrong} wrong of {replays}, at most {at_most(wrong, replays) * 100:.2g} %"
        for verdict, (wrong, replays) in by_class.items()
    ]
    lines += [
        "",
        f"Other disturbances, {asked.sweep} replays of each of the {len(runs)} runs:",
        "",
        "| disturbance | wrong | which |",
        "|---|---|---|",
    ]
    for what, how in SWEEP.items():
        rate = float(what.split()[2]) if "Hz" in what else 100.0
        wrong, where = 0, []
        for name, result in runs:
            got = replay(result, name, how, asked.sweep, rate)
            wrong += got.wrong
            if got.wrong:
                where.append(f"{name} ({got.wrong})")
        lines.append(f"| {what} | {wrong} of {asked.sweep * len(runs)} | {', '.join(where)} |")
        print(lines[-1], flush=True)
    if not asked.dry:
        page = PAGE.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN)
        _, after = rest.split(END)
        PAGE.write_text(before + "\n".join([BEGIN, "", *lines, "", END]) + after, encoding="utf-8")


if __name__ == "__main__":
    main()
