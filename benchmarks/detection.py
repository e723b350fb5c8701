"""Error rates of the capture detector on noisy replays; writes them into docs/detection_checked.md.

.venv/bin/python -m benchmarks.detection    # about eight minutes; --replays 10 for a look
"""

from __future__ import annotations

import dataclasses
import functools
import math
import zlib
from collections import Counter

import numpy as np
from scipy.stats import beta

from benchmarks.pages import table, write_parts
from capture_sim import load_scene, simulate
from tests.injections import QUALITIES, walk
from tests.noisy_replay import Disturbance, disturbed, judge

_AS_THEY_ARE = (
    "tilt_0",
    "tilt_p10",
    "tilt_m10",
    "paper_designed",
    "paper_case_2",
    "paper_undamped",
    "paper_case_1",
    "paper_clamped",
    "paper_case_3",
)
_FAR = ("initial.target.x=0.55",)
#: What is replayed: scene, changes, and what it is called.
CASES = (
    *((name, (), name) for name in _AS_THEY_ARE),
    ("paper_designed", (*_FAR, "initial.target.y=0.09"), "passes 8 mm beside the lip"),
    ("paper_designed", (*_FAR, "initial.target.y=-0.085"), "passes 3 mm beside the lip"),
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


def replay(result, name, how, replays, rate=100.0):
    """Judge a run many times, each with other noise: how many wrong, and how much later, s."""
    decided = next((s.t for s in result.statuses if s.final), result.t[-1])
    wrong, delays = 0, []
    for k in range(replays):
        rng = np.random.default_rng([zlib.crc32(name.encode()), k])
        last, t = judge(result.scene, disturbed(result, how, rng, rate))
        wrong += last.state.label != result.verdict
        delays.append(t - decided)
    return wrong, delays


@functools.cache
def runs():
    """Name and result of every run that is replayed."""
    return [(name, simulate(load_scene(scene, changes))) for scene, changes, name in CASES]


def standard(asked, _):
    """Every run with the standard disturbance."""
    rows, by_verdict = [], {}
    for name, result in runs():
        wrong, delays = replay(result, name, STANDARD, asked.replays)
        rows.append(
            [
                name,
                result.verdict,
                f"{result.samples['tip_distance'].min() * 1e3:.2f}",
                f"{wrong} of {asked.replays}",
                f"{np.median(delays):.2f}",
                f"{max(delays):.2f}",
            ]
        )
        total = by_verdict.setdefault(result.verdict, [0, 0])
        total[0] += wrong
        total[1] += asked.replays
    head = ["run", "verdict", "nearest mm", "wrong", "later by s: median", "worst"]
    return [
        f"{asked.replays} replays of each run, every one with other noise:",
        "",
        table(head, rows),
        "",
        "By verdict (95 % bound of Clopper and Pearson, 1934, on the error rate):",
        "",
        *(
            f"- {verdict}: {wrong} wrong of {count}, at most "
            f"{100.0 * beta.ppf(0.95, wrong + 1, count - wrong):.2g} %"
            for verdict, (wrong, count) in by_verdict.items()
        ),
    ]


def sweep(asked, _):
    """Every run with other disturbances."""
    rows = []
    for what, how in SWEEP.items():
        rate = float(what.split()[2]) if "Hz" in what else 100.0
        wrong = {name: replay(run, name, how, asked.sweep, rate)[0] for name, run in runs()}
        where = ", ".join(f"{name} ({count})" for name, count in wrong.items() if count)
        rows.append([what, f"{sum(wrong.values())} of {asked.sweep * len(runs())}", where])
    return [
        f"Other disturbances, {asked.sweep} replays of each of the {len(runs())} runs:",
        "",
        table(["disturbance", "wrong", "which"], rows),
    ]


#: Kinds of wrong frames, and the largest number of frames; 0: 0.05 to 0.3 s.
_WRONG_FRAMES = {"1 to 3 frames": 3, "1 to 5 frames": 5, "swapped for 0.05 to 0.3 s": 0}
_OUTCOMES = ("equal", "another time", "undecided", "wrong")


def injections(asked, _):
    """Wrong frames injected into the trials of a bench."""
    rows, lines = [], []
    for kind, longest in _WRONG_FRAMES.items():
        for name, quality in QUALITIES.items():
            outcomes = Counter()
            for rate in (60.0, 120.0, 240.0):
                rng = np.random.default_rng([zlib.crc32(kind.encode()), int(rate)])
                result = walk(quality, rate, rng, asked.injections, longest=longest)
                outcomes += result.outcomes
                lines += result.lines
            counts = [outcomes[outcome] for outcome in _OUTCOMES]
            rows.append([kind, name, sum(counts), *counts])
    print(*lines, sep="\n")
    head = ["wrong frames", "noise", "trials", "equal", "other time", "undecided", "wrong"]
    return [
        f"{asked.injections} injections in each of 5 runs at 60, 120 and 240 Hz:",
        "",
        table(head, rows),
    ]


if __name__ == "__main__":
    write_parts(
        "detection_checked",
        __doc__,
        {"standard": standard, "sweep": sweep, "injections": injections},
        replays=(340, "of each run, standard disturbance"),
        sweep=(20, "of each run, other disturbances"),
        injections=(20, "of wrong frames in each run, at each rate"),
    )
