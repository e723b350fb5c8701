"""Error rates of the detector on noisy replays, for docs/evidence/detection_checked.md.

python -m benchmarks.detection    # --replays 10 --sweep 1 --injections 1 for a look

It needs no ROS: from a source tree, with numpy, scipy, numba and PyYAML, PYTHONPATH=. will do.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import multiprocessing
import os
import zlib
from collections import Counter
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from scipy.stats import beta

from benchmarks.pages import table, write_parts
from capture_sim import load_scene, simulate
from tests.injections import QUALITIES, SCENES, walk
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
_STANDARD = "standard"
SWEEP = {
    _STANDARD: STANDARD,
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


def parallel(asked, task, *arguments):
    """Return the answers of a task to arguments, in their order, by ``asked.jobs`` processes."""
    spawned = multiprocessing.get_context("spawn")  # a fork copies the compiler's threads
    with ProcessPoolExecutor(asked.jobs or os.cpu_count(), spawned) as processes:
        return list(processes.map(task, *arguments))


@functools.cache
def run_of(case):
    """Return the run that is replayed."""
    scene, changes, _ = CASES[case]
    return simulate(load_scene(scene, changes))


def replay(case, what, k):
    """Judge a run once, with the noise of number ``k``: whether wrong, and how much later, s."""
    result, name = run_of(case), CASES[case][2]
    how, rate = (SWEEP[what], float(what.split()[2]) if "Hz" in what else 100.0)
    rng = np.random.default_rng([zlib.crc32(name.encode()), k])
    last, t = judge(result.scene, disturbed(result, how, rng, rate))
    decided = next((s.t for s in result.statuses if s.final), result.t[-1])
    return last.state.label != result.verdict, t - decided


def replays(asked, whats, count):
    """Return what :func:`replay` returns, by disturbance and case."""
    tasks = [(case, what, k) for what in whats for case in range(len(CASES)) for k in range(count)]
    answers = parallel(asked, replay, *zip(*tasks, strict=True))
    by_case = {}
    for (case, what, _), answer in zip(tasks, answers, strict=True):
        by_case.setdefault((what, case), []).append(answer)
    return by_case


def standard(asked, _):
    """Every run with the standard disturbance."""
    rows, by_verdict = [], {}
    for (_, case), answers in replays(asked, [_STANDARD], asked.replays).items():
        result, delays = run_of(case), [later for _, later in answers]
        wrong = sum(is_wrong for is_wrong, _ in answers)
        rows.append(
            [
                CASES[case][2],
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
    head = ["run", "verdict", "closest approach mm", "wrong", "later by s: median", "worst"]
    return [
        f"{asked.replays} replays of each run, each with different noise:",
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
    whats = [what for what in SWEEP if what != _STANDARD]
    by_case = replays(asked, whats, asked.sweep)
    for what in whats:
        wrong = {
            CASES[case][2]: sum(is_wrong for is_wrong, _ in by_case[what, case])
            for case in range(len(CASES))
        }
        where = ", ".join(f"{name} ({count})" for name, count in wrong.items() if count)
        rows.append([what, f"{sum(wrong.values())} of {asked.sweep * len(CASES)}", where])
    return [
        f"Other disturbances, {asked.sweep} replays of each of the {len(CASES)} runs:",
        "",
        table(["disturbance", "wrong", "which"], rows),
    ]


#: Kinds of wrong frames, and the largest number of frames; 0: 0.05 to 0.3 s.
_WRONG_FRAMES = {"1 to 3 frames": 3, "1 to 5 frames": 5, "swapped for 0.05 to 0.3 s": 0}
_OUTCOMES = ("equal", "another time", "undecided", "wrong")


def inject(kind, quality, rate, scene, count):
    """Return what wrong frames have done to the verdicts of a scene."""
    rng = np.random.default_rng([zlib.crc32(f"{kind} {scene}".encode()), int(rate)])
    return walk(QUALITIES[quality], rate, rng, count, longest=_WRONG_FRAMES[kind], scenes=[scene])


def injections(asked, _):
    """Wrong frames injected into the trials of a bench."""
    tasks = [
        (kind, quality, rate, scene, asked.injections)
        for kind in _WRONG_FRAMES
        for quality in QUALITIES
        for rate in (60.0, 120.0, 240.0)
        for scene in SCENES
    ]
    by_row = {}
    for (kind, quality, *_), result in zip(
        tasks, parallel(asked, inject, *zip(*tasks, strict=True)), strict=True
    ):
        by_row.setdefault((kind, quality), Counter()).update(result.outcomes)
        print(*result.lines, sep="\n", end="\n" if result.lines else "")
    rows = [
        [*names, sum(counts), *counts]
        for names, outcomes in by_row.items()
        for counts in [[outcomes[outcome] for outcome in _OUTCOMES]]
    ]
    differ = sum(outcomes["reference"] for outcomes in by_row.values())
    head = ["wrong frames", "noise", "trials", "equal", "other time", "undecided", "wrong"]
    return [
        f"{asked.injections} injections in each of {len(SCENES)} runs at 60, 120 and 240 Hz:",
        "",
        table(head, rows),
        "",
        f"Without wrong frames, {differ} of {len(tasks)} streams get another verdict than the run.",
    ]


PARTS = {"standard": standard, "sweep": sweep, "injections": injections}

if __name__ == "__main__":
    write_parts(
        "detection_checked",
        __doc__,
        PARTS,
        untimed=PARTS,
        jobs=(0, "processes; 0: one for each core"),
        replays=(340, "of each run, standard disturbance"),
        sweep=(20, "of each run, other disturbances"),
        injections=(20, "of wrong frames in each run, at each rate"),
    )
