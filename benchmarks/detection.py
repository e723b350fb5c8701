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
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.stats import beta

from benchmarks.pages import table, write_parts
from capture_sim import load_scene, simulate
from capture_sim.errors import RecordingError
from capture_sim.recording.read import read_run
from capture_sim.run.run import detect
from capture_sim.run.verdict import detect_state
from tests import dirty
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


#: Loads whose bounds are compared with those of the run itself.
_PEAKS = ("max_axial_stroke_in", "max_axial_stroke_out", "max_torsion")
#: Scenes of the recordings with drawn faults.
_RIGS = ("tilt_0", "tilt_p10", "tilt_m10")


def drawn(rng, *, has_faults=True, has_latency=True):
    """Return the scene, its changes, the changed records of a rig, and the names of the changes."""
    scene = str(rng.choice(_RIGS))
    speed = rng.uniform(0.05, 0.12)
    changes = (
        f"string.impact_speed={speed:.3f}",
        f"sensors.motion_capture.rate={rng.choice([25, 50, 100, 125, 250])}",
        f"sensors.motion_capture.position_noise={10 ** rng.uniform(-4, -2.8):.2e}",
        f"sensors.load_cell.rate={rng.choice([100, 250, 500, 1000])}",
    )
    seed = int(rng.integers(1000))
    records, names = list(dirty.clean(scene, *changes, seed=seed)), []
    if not has_faults:
        return scene, changes, seed, records, names
    middle = exact_contact(scene, changes, seed)[0] + rng.uniform(-0.3, 0.3)
    topics = (dirty.CHASER, dirty.TARGET, dirty.JOINTS, dirty.CELL)
    if rng.random() < 0.5:
        zero = (rng.uniform(-5e-3, 5e-3), rng.uniform(-0.05, 0.05))
        records = dirty.changed(records, dirty.JOINTS, dirty.off_zero(*zero))
        names.append("zero")
    if rng.random() < 0.4:
        width, count = 10 ** rng.uniform(-1.7, 0.2), int(rng.integers(1, 5))
        lost = set(rng.choice(topics, count, replace=False))
        low, high = middle - width * rng.uniform(), middle + width * rng.uniform()
        records = [r for r in records if not (r.topic in lost and low < r.t < high)]
        names.append("hole")
    if rng.random() < 0.2:
        half = 1_500_000
        again = [r.stamped(r.stamp + half) for r in records if "capture" in r.topic]
        records = [*records, *(r._replace(log_time=r.log_time + half) for r in again)]
        records.sort(key=lambda r: r.log_time)
        names.append("repeats")
    if rng.random() < 0.3 and has_latency:
        late = int(rng.uniform(0, 20e6))
        source = [topics[:2], topics[2:3], topics[3:]][int(rng.integers(3))]
        records = dirty.restamped(records, source, lambda stamp: stamp + late)
        names.append("latency")
    if rng.random() < 0.1:
        records = [r for r in records if r.t > middle]
        names.append("late begin")
    return scene, changes, seed, records, names


@functools.lru_cache(4)
def exact_contact(scene, changes, seed):
    """Return the first contact and the begin of the verdict's state of a run, s, and its loads."""
    sensors = ("sensors.motion_capture={}", "sensors.load_cell={}", f"sensors.seed={seed}")
    run = simulate(scene, [*sensors, *changes])
    last = detect_state(run.samples, run.scene, is_cut=False)[-1]
    return float(run.touches["start"].min()), last.t - last.time_in_state, last.state, run.loads


def bound(k, *, has_latency=True):
    """Return what the bounds of a drawn recording are worth: faults, both times, loads."""
    rng = np.random.default_rng([71, k])
    scene, changes, seed, records, names = drawn(rng, has_latency=has_latency)
    contact, since, state, loads = exact_contact(scene, changes, seed)
    with TemporaryDirectory() as folder:
        path = dirty.write_mcap(Path(folder) / "rig.mcap", records)
        run = read_run(path, scene=load_scene(scene, list(changes)), release=None)
        begin = min(r.t for r in records if "capture" in r.topic)
        bounds = run.contact_bounds
        first = None
        if bounds is not None:
            low, high = bounds.low + begin, bounds.high + begin
            slack = 1e-6
            first = (low - slack <= contact <= high + slack, low, high, contact)
        peaks = [
            (low <= loads[key] <= high, low, high, loads[key], key)
            for key, (low, high, _) in (run.load_bounds or {}).items()
            if key in _PEAKS
        ]
        try:
            last = detect(run)[-1]
        except RecordingError as error:
            return names, first, str(error)[:160], peaks
        high = last.t - last.time_in_state + begin
        low, high = high - last.may_precede, high + last.may_follow
        verdict = None
        if last.state is state and state.is_verdict:
            verdict = (low <= since <= high, low, high, since)
        verdict = verdict if verdict else f"{last.state.label}, not {state.label}"
        return names, first, verdict, peaks


def alarms(k):
    """Return what the rules say of a clean drawn recording, one line each."""
    rng = np.random.default_rng([72, k])
    scene, changes, _, records, _ = drawn(rng, has_faults=False)
    with TemporaryDirectory() as folder:
        path = dirty.write_mcap(Path(folder) / "rig.mcap", records)
        return [d.line for d in read_run(path, scene=load_scene(scene, list(changes))).doubts]


def scales(k):
    """Return whether a stroke of half and of double the scale is named in a drawn recording."""
    rng = np.random.default_rng([72, k])
    scene, changes, _, records, _ = drawn(rng, has_faults=False)
    named = []
    with TemporaryDirectory() as folder:
        for factor in (0.5, 2.0):
            scaled = dirty.changed(records, dirty.JOINTS, dirty.scaled_stroke(factor))
            path = dirty.write_mcap(Path(folder) / f"{factor}.mcap", scaled)
            doubts = read_run(path, scene=load_scene(scene, list(changes))).doubts
            named.append(any("scale" in d.line or d.grade.value == "refused" for d in doubts))
    return named


def clean(asked, _):
    """Rules of plausibility in recordings without a fault."""
    lines = parallel(asked, alarms, range(asked.bounds))
    print(*(line for found in lines for line in found), sep="\n")
    wrong = sum(map(bool, lines))
    half, double = np.sum(parallel(asked, scales, range(asked.bounds)), axis=0)
    return [
        f"A rule is broken in {wrong} of {asked.bounds} drawn recordings without a fault. With a "
        f"stroke of half its scale the scale is named, or the recording refused, in {half}, with "
        f"the double in {double}."
    ]


def bounds(asked, _):
    """Bounds of times in recordings with drawn faults."""
    answers = parallel(asked, bound, range(asked.bounds))
    rows = []
    for what in ("any", "none", "zero", "hole", "repeats", "latency", "late begin"):
        mine = [a for a in answers if what in ("any", *(a[0] or ["none"]))]
        row = [what, str(len(mine))]
        for index in (1, 2):
            known = [a[index] for a in mine if isinstance(a[index], tuple)]
            inside = sum(found[0] for found in known)
            width = float(np.median([found[2] - found[1] for found in known])) if known else np.nan
            row += [f"{inside} of {len(known)}", f"{1e3 * width:.3g}"]
        peaks = [peak for answer in mine for peak in answer[3]]
        closed = [(high - low) / true for _, low, high, true, _ in peaks if math.isfinite(high)]
        row.append(f"{sum(peak[0] for peak in peaks)} of {len(peaks)}")
        rows.append([*row, str(len(closed)), f"{np.median(closed):.1%}" if closed else "-"])
    for names, first, verdict, peaks in answers:
        if first is None or not first[0] or not isinstance(verdict, tuple) or not verdict[0]:
            print(names, first, verdict)
        print(*(f"{names} {peak}\n" for peak in peaks if not peak[0]), sep="", end="")
    head = ["fault", "recordings", "contact inside", "width ms", "verdict inside", "width ms"]
    head += ["strokes, torsion inside", "with both bounds", "width / truth"]
    return [
        f"{asked.bounds} recordings of the experiments with drawn speeds, rates, noise and faults:",
        "",
        table(head, rows),
    ]


PARTS = {"standard": standard, "sweep": sweep, "injections": injections, "bounds": bounds}
PARTS["clean"] = clean

if __name__ == "__main__":
    write_parts(
        "detection_checked",
        __doc__,
        PARTS,
        untimed=PARTS,
        jobs=(0, "processes; 0: one for each core"),
        replays=(340, "of each run, standard disturbance"),
        sweep=(20, "of each run, other disturbances"),
        bounds=(200, "recordings with drawn faults"),
        injections=(20, "of wrong frames in each run, at each rate"),
    )
