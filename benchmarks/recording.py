"""Measure recording, recovery, replay and identification; write the figures into docs/recording.md.

    .venv/bin/python benchmarks/recording.py [--only write live recover replay identify]
                                             [--seconds 60] [--page docs/recording.md]

Takes about three minutes; the machine should be doing nothing else.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml

import capture_sim
from benchmarks.machine import clock_rate, describe, load
from capture_sim.messages.convert import RunDescription
from capture_sim.recording.live import LiveRecorder
from capture_sim.recording.offline import PUBLISHERS, run_stream, write_run
from capture_sim.recording.read import read_run
from capture_sim.recording.write import RunWriter
from capture_sim.studies.identify import RELEASE, identify, is_explained
from tests.noisy_bench import NAMES, noisy_run
from tests.recording.damage import cuts, expected, flips, saved_rightly

ROOT = Path(__file__).resolve().parent.parent
EXPERIMENTS = ("tilt_0", "tilt_p10", "tilt_m10")
BEGIN, END = "<!-- measured: {} -->", "<!-- end of measured -->"
REPEATS = 5


def long_scene(seconds: float, rate: float) -> capture_sim.Scene:
    """Return an experiment that goes on for so long: without latches nothing ends it."""
    changes = ["latch=null", f"run.t_end={seconds}", f"run.rate={rate}"]
    return capture_sim.load_scene("tilt_0", changes)


def median_time(work: Callable[[], object]) -> tuple[float, float]:
    """Return median and spread (largest less smallest) of the time that work takes, s."""
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return statistics.median(times), max(times) - min(times)


def measure_writing(folder: Path) -> str:
    """Write and read 20 s at 1 kHz on all topics."""
    result = capture_sim.simulate(long_scene(20.0, 1000.0))
    path = folder / "long.mcap"
    run = RunDescription.of(result.scene, "x", PUBLISHERS)
    stream = list(run_stream(result, run))

    def write_alone() -> None:
        (folder / "alone.mcap").unlink(missing_ok=True)
        with RunWriter(folder / "alone.mcap", run) as writer:
            for topic, stamp, data in stream:
                writer.write(topic, data, stamp)

    def read_all() -> None:
        found = read_run(path)
        for topic in found.topics:
            found.columns(topic)

    rows = []
    writing = median_time(lambda: write_run(result, path))
    count = sum(read_run(path).topics.values())
    for what, (seconds, spread) in (
        ("made, serialised and written (`write_run`)", writing),
        ("written alone (`RunWriter`)", median_time(write_alone)),
        ("read, checksums checked (`read_run`)", median_time(lambda: read_run(path))),
        ("read into columns of all topics", median_time(read_all)),
    ):
        rows.append(
            f"| {what} | {count / seconds / 1e3:.0f} k/s | {seconds:.3f} s +- {spread / 2:.3f} |"
        )
    began = time.process_time()
    with tempfile.TemporaryDirectory(dir=folder) as out:
        recorder = LiveRecorder(out)
        for topic, _, data in stream:
            recorder.take(topic, data)
        assert recorder.close().complete
    seconds = time.process_time() - began
    rows.append(
        f"| taken by the live recorder, without ROS | {count / seconds / 1e3:.0f} k/s "
        f"| {seconds:.3f} s of processor time |"
    )
    return "\n".join(
        [
            f"{count} messages, {path.stat().st_size / 1e6:.1f} MB: 20 s with every topic at "
            f"1 kHz; medians of {REPEATS}.",
            "",
            "| | messages | time |",
            "|---|---|---|",
            *rows,
        ]
    )


def measure_live(folder: Path, seconds: float) -> str:
    """Record a paced run of the nodes; return the recorder's share of a core and its losses."""
    scene = folder / "scene.yaml"
    scene.write_text(long_scene(seconds, 100.0).to_yaml())
    out = folder / "live"
    followers = ["launcher", "capture_detector", "recorder"]
    of_node: dict[str, dict[str, object]] = {name: {} for name in ("simulator", *followers)}
    of_node["simulator"] = {"scenes": [str(scene)], "consumers": followers, "rtf": 1.0}
    of_node["recorder"] = {"out": str(out)}
    parameters = folder / "parameters.yaml"
    parameters.write_text(
        yaml.safe_dump(
            {
                name: {"ros__parameters": {"exit_when_done": True, **values}}
                for name, values in of_node.items()
            }
        )
    )
    nodes = {
        name: subprocess.Popen(
            [
                *(sys.executable, "-m", f"capture_sim.nodes.{name}"),
                *("--ros-args", "--params-file", str(parameters)),
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for name in of_node
    }
    ticks = os.sysconf("SC_CLK_TCK")

    def spent(name: str) -> float:
        fields = Path(f"/proc/{nodes[name].pid}/stat").read_text().rsplit(") ", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / ticks

    try:
        stdout = nodes["simulator"].stdout
        assert stdout is not None
        for line in stdout:
            if "released" in line:
                break
        time.sleep(2.0)
        began, before = time.monotonic(), {name: spent(name) for name in nodes}
        time.sleep(seconds - 5.0)
        lasted = time.monotonic() - began
        share = {name: (spent(name) - before[name]) / lasted for name in nodes}
        texts = {name: process.communicate(timeout=60)[0] for name, process in nodes.items()}
    finally:
        for process in nodes.values():
            if process.poll() is None:
                process.kill()
    (path,) = out.glob("*.mcap")
    run = read_run(path)
    assert "complete" in texts["recorder"], texts["recorder"]
    lost = list(run.problems)
    # the rest of the nodes compete for the same cores: their shares belong to the figure
    others = ", ".join(f"{name} {share[name]:.0%}" for name in nodes if name != "recorder")
    return (
        f"{seconds:.0f} s in real time, bench/state at 1 kHz, the other topics at 100 Hz "
        f"({sum(run.topics.values())} messages, "
        f"{sum(run.topics.values()) / seconds:.0f} a second): the recorder took "
        f"**{share['recorder']:.1%}** of one core and missed "
        f"**{'nothing' if not lost else '; '.join(lost)}**. Beside it: {others}."
    )


def measure_recovery(folder: Path) -> str:
    """Cut and change a recording 50 times each."""
    path = write_run(capture_sim.simulate(capture_sim.load_scene("tilt_m10")), folder / "x.mcap")
    chunks = expected(path)
    broken = folder / "broken.mcap"
    rows = []
    for what, trials, key in (
        ("cut at a random place", cuts(path, 50, 7), "cut"),
        ("one random bit changed", flips(path, 50, 7), "flipped"),
    ):
        came: Counter[str] = Counter()
        for data, at in trials:
            broken.write_bytes(data)
            came[saved_rightly(broken, chunks, **{key: at})] += 1
        rows.append(f"| {what} | {came['saved']} | {came['refused']} | {came['']} |")
    return "\n".join(
        [
            f"A run of {len(chunks)} chunks, damaged 50 times each:",
            "",
            "| | every whole chunk saved, loss reported | no whole chunk in it, refused | wrong |",
            "|---|---|---|---|",
            *rows,
        ]
    )


def measure_replay(folder: Path) -> str:
    """Play the experiments at ten times real time for detector and recorder."""
    rows = []
    for name in EXPERIMENTS:
        scene = capture_sim.load_scene(name)
        path = write_run(capture_sim.simulate(scene), folder / f"{name}.mcap")
        done = subprocess.run(
            [
                *(sys.executable, "-m", "capture_sim.cli", "replay", str(path), "--rtf", "10"),
                *("--with", "capture_detector", "recorder", "--out", str(folder / "replayed")),
            ],
            capture_output=True,
            text=True,
            timeout=180,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        (rate,) = re.findall(r"\(([\d.]+) x real time\)", done.stdout + done.stderr)
        one, two = read_run(path), read_run(folder / "replayed" / f"{name}.mcap")
        lost = sum(
            len(one.raw(topic)) - len(two.raw(topic))
            for topic in one.topics
            if topic not in ("/capture/status", "/bench/stream_counts")
        )
        before, after = one.statuses[-1], two.statuses[-1]
        since = [s.t - s.time_in_state for s in (before, after)]
        rows.append(
            f"| {name} | {sum(one.topics.values())} | {lost} | {rate} "
            f"| {before.state.label} at {since[0]:.3f} s "
            f"| {after.state.label} at {since[1]:.3f} s |"
        )
    return "\n".join(
        [
            "| | messages | lost | x real time (wanted: 10) | recorded | judged in the replay |",
            "|---|---|---|---|---|---|",
            *rows,
        ]
    )


def measure_identification(_: Path) -> str:
    """Fit four parameters to 20 noisy runs."""
    within: Counter[str] = Counter()
    tables = {}
    for way in ("all", "poses", "release", "wrong"):
        deviations, relative, seconds = [], [], []
        failed = 0
        for seed in range(20):
            run = noisy_run(EXPERIMENTS[seed % 3], 100 + seed)
            measured, touches, names = run.measured, run.touches, list(NAMES)
            true = size = run.true
            if way in ("release", "wrong"):  # is not when it is taken for
                wide = float(np.random.default_rng(seed).uniform(-0.1, 0.1))
                late = wide if way == "release" else 1e-3
                measured = measured.shifted(late)
                touches = dataclasses.replace(touches, start=touches.start + late)
                if way == "release":
                    names, true, size = [*NAMES, RELEASE], np.append(true, late), [*size, 1.0]
            began = time.perf_counter()
            fit = identify(
                run.scene,
                measured,
                names,
                plan=run.plan,
                touches=None if way == "poses" else touches,
            )
            seconds.append(time.perf_counter() - began)
            failed += not is_explained(fit)
            deviations.append((fit.values - true) / fit.errors)
            relative.append(fit.errors / size)
        z = np.abs(np.array(deviations))
        errors = np.median(relative, axis=0)
        tables[way] = (z, errors, failed, statistics.median(seconds))
        within[way] = int((z < 2.0).sum())
    z, errors, failed, seconds_each = tables["all"]
    rows = []
    for i, name in enumerate(NAMES):
        others = " ".join(
            f"| {int((off[:, i] < 2.0).sum())} of 20 | {error[i]:.2%}"
            for off, error, *_ in (tables["poses"], tables["release"])
        )
        rows.append(
            f"| {name} | {int((z[:, i] < 2.0).sum())} of 20 | {z[:, i].max():.1f} "
            f"| {errors[i]:.2%} {others} |"
        )
    off, found, off_failed, off_seconds = tables["release"]
    wrong, _, warned, _ = tables["wrong"]
    return "\n".join(
        [
            f"{within['all']} of 80 parameters ({within['all'] / 80:.0%}) lie within two of their "
            f"own standard errors of the truth; without touches {within['poses']} "
            f"({within['poses'] / 80:.0%}). {failed} of 20 fits left more than noise explains; "
            f"a fit takes {seconds_each:.1f} s (median). With the release taken wrongly, by up to "
            f"0.1 s, and fitted too: {within['release']} of 100, the release itself "
            f"{int((off[:, 4] < 2.0).sum())} of 20 within two errors of {1e3 * found[4]:.2f} ms "
            f"(median); {off_failed} of 20 left more than noise explains; {off_seconds:.1f} s. "
            f"Taken wrongly by 1 ms and not fitted: c_rr is off by {wrong[:, 0].min():.0f} to "
            f"{wrong[:, 0].max():.0f} of its errors, e by up to {wrong[:, 1].max():.1f}, and "
            f"{warned} of 20 fits say so.",
            "",
            "| | within 2 errors | farthest, errors | standard error (median) "
            "| without touches | standard error | release fitted | standard error |",
            "|---|---|---|---|---|---|---|---|",
            *rows,
        ]
    )


def machine() -> str:
    """Return what it was measured on."""
    told = describe(clock_rate())
    names = ("date", "processor", "clock under load", "cores", "Python")
    return (
        ", ".join(f"{name} {told[name]}" for name in names) + f"; load at the start {load():.1f}."
    )


def replace_section(page: Path, name: str, text: str) -> None:
    """Put text between the marks of a section of the page."""
    content = page.read_text(encoding="utf-8")
    begin = BEGIN.format(name)
    head, _, rest = content.partition(begin)
    if not rest:
        raise SystemExit(f"{page}: has no {begin}")
    _, _, tail = rest.partition(END)
    page.write_text(f"{head}{begin}\n{text}\n{END}{tail}", encoding="utf-8")


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parts = ("write", "live", "recover", "replay", "identify")
    parser.add_argument("--only", nargs="+", choices=parts, default=parts)
    parser.add_argument("--seconds", type=float, default=60.0, help="of the live recording")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "recording.md")
    options = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 101))
    with tempfile.TemporaryDirectory(prefix="capture_sim_") as folder:
        os.environ.setdefault("ROS_LOG_DIR", str(Path(folder) / "log"))
        measures: dict[str, Callable[[Path], str]] = {
            "write": measure_writing,
            "live": lambda where: measure_live(where, options.seconds),
            "recover": measure_recovery,
            "replay": measure_replay,
            "identify": measure_identification,
        }
        replace_section(options.page, "machine", machine())
        for name in options.only:
            where = Path(folder) / name
            where.mkdir()
            text = measures[name](where)
            print(f"{name}\n{text}\n", flush=True)
            replace_section(options.page, name, text)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
