"""Recording, replay and identification; writes the parts of docs/evidence/node_suite.md.

python -m benchmarks.recording                  # all parts, about six minutes
python -m benchmarks.recording write live
"""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from benchmarks.node_suite import Suite, endless
from benchmarks.pages import Spread, repeated, table, write_parts
from capture_sim import load_scene, simulate
from capture_sim.messages.convert import RunDescription
from capture_sim.messages.topics import RUN_INFO
from capture_sim.recording.bag import read_bag
from capture_sim.recording.export import tables_of
from capture_sim.recording.live import LiveRecorder
from capture_sim.recording.offline import PUBLISHERS, run_stream, write_run
from capture_sim.recording.write import RunWriter
from capture_sim.run.series import Series
from capture_sim.run.touches import Touches
from tests import dirty
from tests.nodes.bench_processes import processes
from tests.noisy_bench import (
    CELL_RATE,
    NAMES,
    PEAK_NOISE,
    START_NOISE,
    NoisyRun,
    cell_force,
    counted,
    later,
    noisy_run,
    tip_force,
)
from tests.one_trial import RELEASE, identify, is_explained

EXPERIMENTS = ("tilt_0", "tilt_p10", "tilt_m10")
REPEATS = 5


def write(_: Namespace, folder: Path) -> list[str]:
    """Write and read 20 s at 1 kHz on all topics."""
    result = simulate(load_scene("tilt_0", ["latch=null", "run.t_end=20", "run.rate=1000"]))
    path, run = folder / "long.mcap", RunDescription.of(result.scene, "x", PUBLISHERS)
    stream = list(run_stream(result, run))
    info = next(data for topic, _, data in stream if topic is RUN_INFO)

    def write_alone() -> None:
        (folder / "alone.mcap").unlink(missing_ok=True)
        with RunWriter(folder / "alone.mcap", run) as writer:
            for topic, stamp, data in stream:
                writer.write(topic, data, stamp)

    def read_columns() -> None:
        assert all(each.fields for each in tables_of(read_bag(path)).values())

    def take() -> None:
        with tempfile.TemporaryDirectory(dir=folder) as out:
            recorder = LiveRecorder(out, info)
            for topic, _, data in stream:
                if topic is not RUN_INFO:
                    recorder.take(topic, data)
            assert recorder.close().complete

    rows = []
    for what, work in (
        ("made, serialised and written (`write_run`)", lambda: write_run(result, path)),
        ("written alone (`RunWriter`)", write_alone),
        ("read, checksums checked (`read_bag`)", lambda: read_bag(path)),
        ("read into tables of all topics (`export`)", read_columns),
        ("written by the live recorder, without ROS", take),
    ):
        took = repeated(work, REPEATS, time.process_time)
        median = Spread.of(took).median
        spread = f"{min(took):.3f} to {max(took):.3f}"
        rows.append([what, f"{len(stream) / median / 1e3:.0f} k/s", f"{median:.3f}", spread])
    return [
        f"{len(stream)} messages, {path.stat().st_size / 1e6:.1f} MB: 20 s with every topic at "
        f"1 kHz; medians of {REPEATS}.",
        "",
        table(["", "messages", "CPU time, s", "minimum to maximum"], rows),
    ]


#: Sizes of files with cameras, GB; bytes of an image.
_SIZES, _IMAGE = (0.0, 0.1, 1.0, 5.0), 2 << 20
#: The library's own reader, over the topics that ``detect`` uses.
_LIBRARY = """
import sys
from mcap.reader import make_reader
with open(sys.argv[1], "rb") as file:
    reader = make_reader(file, validate_crcs=sys.argv[2] == "checked")
    for schema, channel, message in reader.iter_messages(topics=sys.argv[3:]):
        pass
"""
_DETECT = """
import sys
from capture_sim.cli import main
assert main(["detect", sys.argv[1], "--scene", "tilt_p10"]) == 0
"""
# the peak since the program began; ru_maxrss has that of its parent too
_OWN_COST = """
import time
(peak,) = [line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")]
print(time.process_time(), int(peak) / 1024)
"""


def _with_cameras(source: Path, path: Path, size: float) -> Path:
    """Copy a recording with ``size`` GB of noise as images of two cameras, without compression."""
    image = np.random.default_rng(1).integers(0, 256, _IMAGE, dtype=np.uint8).tobytes()
    with source.open("rb") as read, path.open("wb") as write:
        writer = Writer(write, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="another recorder")
        schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"uint8[] data")
        cameras = [writer.register_channel(f"/camera{k}/image", "cdr", schema) for k in range(2)]
        stored = list(make_reader(read).iter_messages())
        channels: dict[str, int] = {}
        count = int(size * 1e9 / _IMAGE)
        for k, (known, channel, message) in enumerate(stored):
            if channel.topic not in channels:
                schema = writer.register_schema(known.name, known.encoding, known.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", schema)
            time = message.log_time
            writer.add_message(channels[channel.topic], time, message.data, time)
            for i in range(count * k // len(stored), count * (k + 1) // len(stored)):
                writer.add_message(cameras[i % 2], time, image, time)
        writer.finish()
    return path


def _cost(code: str, *arguments: str) -> tuple[float, float]:
    """Return the CPU time, s, and the peak of the memory, MB, of a program in Python."""
    command = [sys.executable, "-c", code + _OWN_COST, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    seconds, memory = map(float, done.stdout.splitlines()[-1].split())
    return seconds, memory


def size(_: Namespace, folder: Path) -> list[str]:
    """Evaluate a rig's recording beside images of cameras."""
    source = dirty.write_mcap(folder / "rig.mcap", dirty.clean("tilt_p10"))
    used = list(read_bag(source).topics)
    rows = []
    for gigabytes in _SIZES:
        path = _with_cameras(source, folder / "big.mcap", gigabytes)
        own, memory = _cost(_DETECT, str(path))
        plain, _ = _cost(_LIBRARY, str(path), "unchecked", *used)
        checked, _ = _cost(_LIBRARY, str(path), "checked", *used)
        row = [f"{path.stat().st_size / 1e9:.3f} GB", f"{memory:.0f} MB", f"{own:.2f} s"]
        rows.append([*row, f"{plain:.2f} s", f"{checked:.2f} s", f"{own / checked:.2f}"])
    head = ["file", "memory of `detect`", "its CPU time", "`mcap` over the used topics"]
    head += ["... with checksums", "`detect` / with checksums"]
    return [table(head, rows)]


def live(asked: Namespace, folder: Path) -> list[str]:
    """Record a paced run of the nodes."""
    seconds = asked.seconds
    with processes() as start:
        suite = Suite(start, folder, rtf=1.0, overrides=endless(seconds))
        shares = suite.shares(seconds - 3.0)
        suite.end()
    run = suite.recorded()
    count = sum(run.topics.values())
    # the rest of the nodes compete for the same cores: their shares belong to the figure
    others = ", ".join(f"{name} {value:.1%}" for name, value in shares.items())
    return [
        f"{seconds:.0f} s in real time, bench/state at 1 kHz, the other topics at 100 Hz ({count} "
        f"messages, {count / seconds:.0f} a second), lost: {'; '.join(run.problems) or 'none'}. "
        f"Shares of a core: {others}."
    ]


def replay(_: Namespace, folder: Path) -> list[str]:
    """Play the experiments at ten times real time for detector and recorder."""
    rows = []
    for name in EXPERIMENTS:
        path = write_run(simulate(load_scene(name)), folder / f"{name}.mcap")
        command = [sys.executable, "-m", "capture_sim.cli", "replay", str(path), "--rtf", "10"]
        command += ["--with", "capture_detector", "recorder", "--out", str(folder / "replayed")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=180)
        said = done.stdout + done.stderr
        assert done.returncode == 0, said
        (rate,) = re.findall(r"\(([\d.]+) x real time\)", said)
        one, two = read_bag(path), read_bag(folder / "replayed" / f"{name}.mcap")
        lost = sum(
            len(one.raw(topic)) - len(two.raw(topic))
            for topic in one.topics
            if topic not in ("/capture/status", "/bench/stream_counts")
        )
        verdicts = [
            f"{last.state.label} at {last.t - last.time_in_state:.3f} s"
            for last in (one.statuses[-1], two.statuses[-1])
        ]
        rows.append([name, sum(one.topics.values()), lost, rate, *verdicts])
    head = ["", "messages", "lost", "real-time factor (requested: 10)"]
    head += ["recorded verdict", "verdict in the replay"]
    return [table(head, rows)]


class Fits(NamedTuple):
    """20 fits: how far each parameter is off in its own standard errors, and those errors."""

    off: np.ndarray  # (20, n)
    errors: np.ndarray  # (n,), medians, relative; of the release s
    warned: int  # fits that left more than noise explains
    seconds: float  # median

    def within(self, i: int | slice = slice(None)) -> int:
        """How many are within two errors."""
        return int((self.off[:, i] < 2.0).sum())


def fits(touches: bool = True, late: str = "") -> Fits:
    """Fit 20 noisy runs; the release is taken too late and ``fitted``, or not."""
    off, errors, took, warned = [], [], [], 0
    for seed in range(20):
        run = noisy_run(EXPERIMENTS[seed % 3], 100 + seed)
        names, true, size = list(NAMES), run.true, run.true
        shift = 0.0
        if late == "fitted":
            shift = float(np.random.default_rng(seed).uniform(-0.1, 0.1))
            names, true, size = [*NAMES, RELEASE], np.append(true, shift), np.append(size, 1.0)
        elif late:
            shift = 1e-3
        met = dataclasses.replace(run.touches, start=run.touches.start + shift)
        measured = later(run.run, shift)
        began = time.perf_counter()
        fit = identify(run.scene, measured, names, touches=met if touches else None)
        took.append(time.perf_counter() - began)
        warned += not is_explained(fit)
        off.append(np.abs(fit.values - true) / fit.errors)
        errors.append(fit.errors / size)
    return Fits(np.array(off), np.median(errors, axis=0), warned, Spread.of(took).median)


def fit(*_: object) -> list[str]:
    """Fit four parameters to 20 noisy runs."""
    whole, poses, release, wrong = (
        fits(),
        fits(touches=False),
        fits(late="fitted"),
        fits(late="ignored"),
    )
    rows = []
    for i, name in enumerate(NAMES):
        row = [name, f"{whole.within(i)} of 20", f"{whole.off[:, i].max():.1f}"]
        row.append(f"{whole.errors[i]:.2%}")
        for other in (poses, release):
            row += [f"{other.within(i)} of 20", f"{other.errors[i]:.2%}"]
        rows.append(row)
    head = ["", "within 2 errors", "maximum, errors", "standard error (median)"]
    head += ["without touches", "standard error", "release fitted", "standard error"]
    return [
        f"{whole.within()} of 80 parameters ({whole.within() / 80:.0%}) lie within two of their "
        f"own standard errors of the truth; without touches {poses.within()} "
        f"({poses.within() / 80:.0%}). {whole.warned} of 20 fits exceeded the noise floor; a "
        f"fit takes {whole.seconds:.1f} s (median). With a release time that starts up to "
        f"0.1 s wrong and is fitted too: {release.within()} of 100, the release itself "
        f"{release.within(4)} of 20 within two errors of {1e3 * release.errors[4]:.2f} ms "
        f"(median); {release.warned} of 20 exceeded the noise floor; {release.seconds:.1f} s. "
        "With a release time wrong by 1 ms and not fitted: c_rr deviates by "
        f"{wrong.off[:, 0].min():.0f} to {wrong.off[:, 0].max():.0f} of its standard errors, e by "
        f"up to {wrong.off[:, 1].max():.1f}, and {wrong.warned} of 20 fits report it.",
        "",
        table(head, rows),
    ]


#: Parameters of the runs whose touches are measured in several ways, as in NAMES.
_TRUE = (0.001, 0.6, 0.33, 13.0)
#: Bandwidths of load cells, and rates of messages that count touches, Hz.
_BANDWIDTHS, _RATES = (8e3, 4e3), (1e3, 2e3)


def _found_in(run: NoisyRun, quantity: str, force: Series) -> Touches | None:
    """Return the touches that a recording with this force shows."""
    series = {**run.run.series, quantity: {"a sensor": force}}
    return run.run.replaced(scene=run.scene, series=series).resolved_touches[0]


def restitution(asked: Namespace, _: Path) -> list[str]:
    """Fit runs of one bench whose touches are measured in several ways: is e biased?"""
    ways: dict[str, Callable[[NoisyRun, np.random.Generator], Touches | None]] = {
        "located touches with noise": lambda run, _: run.touches,
        f"force at {CELL_RATE / 1e3:.0f} kHz": lambda run, rng: _found_in(
            run, "tip_force", tip_force(run, rng)
        ),
    }
    for bandwidth in _BANDWIDTHS:
        ways[f"the same through a filter of {bandwidth / 1e3:.0f} kHz"] = (
            lambda run, rng, bandwidth=bandwidth: _found_in(
                run, "cone_force", cell_force(run, rng, bandwidth)
            )
        )
    for rate in _RATES:
        ways[f"peaks and counts at {rate / 1e3:.0f} kHz"] = lambda run, rng, rate=rate: counted(
            run, rng, rate
        )
    rows = []
    for name, measure in ways.items():
        off, values = [], []
        for seed in range(asked.seeds):
            run = noisy_run("tilt_0", seed, true=_TRUE)
            found = measure(run, np.random.default_rng(1000 + seed))
            assert found is not None
            touches = found.of(slice(4)).with_default_noise(START_NOISE, PEAK_NOISE)
            fit = identify(run.scene, run.run, NAMES, touches=touches, starts=1)
            e = NAMES.index("e")
            values.append(fit.values[e])
            off.append((fit.values[e] - run.true[e]) / fit.errors[e])
        row = [name, f"{np.mean(values):.4f}", f"{np.std(values, ddof=1):.4f}"]
        rows.append([*row, f"{np.mean(off):+.2f}", f"{np.std(off, ddof=1):.2f}"])
    head = ["touches from", f"mean e (true: {_TRUE[1]})", "standard deviation"]
    head += ["mean deviation, standard errors", "its standard deviation"]
    return [f"{asked.seeds} runs each.", "", table(head, rows)]


if __name__ == "__main__":
    parts = {"write": write, "size": size, "live": live, "replay": replay, "identify": fit}
    parts["restitution"] = restitution
    write_parts(
        "node_suite",
        __doc__,
        parts,
        untimed=("restitution",),
        seconds=(60.0, "of the live recording"),
        seeds=(48, "runs for each way to measure touches"),
    )
