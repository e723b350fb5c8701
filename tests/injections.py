"""Streams of a bench's poses and buffer with wrong frames injected, for the detector's tests.

Noise and losses are those of motion capture: `standard` (0.05 mm, 0.03 degrees) and `hard`
(0.3 mm, 0.15 degrees, bursts of lost frames).  A stream begins before the release, with the
chaser held, and ends after the verdict.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim import Bench, load_scene, simulate
from capture_sim.detection.criteria import CaptureStatus
from capture_sim.detection.detector import CaptureDetector
from capture_sim.detection.measurements import Source
from capture_sim.scene.parts import Scene

#: A stamp of today: a bench's clock counts from 1970, ns.
STAMP_OF_RELEASE = 1_790_000_000_123_456_789
#: Time before the release and after the verdict, s.
HELD, AFTER = 1.5, 1.5
#: Wrong frames begin in this time before the release, and after the verdict, s.
MARGIN = 1.0

_UNDAMPED = load_scene("paper_undamped").initial.target.x + 0.1
#: The three experiments, a rebound and a miss.
SCENES = {
    "tilt_0": ("tilt_0", ()),
    "tilt_p10": ("tilt_p10", ()),
    "tilt_m10": ("tilt_m10", ()),
    "rebound": ("paper_undamped", (f"initial.target.x={_UNDAMPED}",)),
    "missed": ("paper_designed", ("initial.target.x=0.55", "initial.target.y=-0.085")),
}
Measurement = tuple[Source, int, tuple[float, ...]]


@dataclass(frozen=True)
class Quality:
    """Standard deviations (m, rad), jitter of the stamps (s), share of lost frames, bursts (1/s).

    ``rounded``: step of both poses, m and rad; ``is_clamped``: the target's pose repeats exactly.
    """

    position: float = 0.0
    angle: float = 0.0
    stroke: float = 0.0
    jitter: float = 0.0
    lost: float = 0.0
    bursts: float = 0.0
    rounded: float = 0.0
    is_clamped: bool = False


CLEAN = Quality()
STANDARD = Quality(5e-5, math.radians(0.03), 1e-5, 1e-3, 1e-3)
HARD = Quality(3e-4, math.radians(0.15), 5e-5, 5e-3, 0.02, 0.2)
QUALITIES = {"clean": CLEAN, "standard": STANDARD, "hard": HARD}


@dataclass(frozen=True)
class Stream:
    """Stamps (ns) and values of each source, in order; times are s since the release."""

    scene: Scene
    verdict: CaptureStatus  # of the exact run
    stamps: dict[Source, np.ndarray]
    values: dict[Source, np.ndarray]

    def times(self, source: Source) -> np.ndarray:
        """Return the times of a source's measurements, s since the release."""
        return (self.stamps[source] - STAMP_OF_RELEASE) / 1e9

    def with_values(self, source: Source, values: np.ndarray) -> Stream:
        """Return the stream with other values of a source."""
        return dataclasses.replace(self, values={**self.values, source: values})

    def since(self, t: float) -> Stream:
        """Return what is measured from a time on, s."""
        kept = {source: self.times(source) >= t for source in Source}
        stamps = {source: self.stamps[source][kept[source]] for source in Source}
        values = {source: self.values[source][kept[source]] for source in Source}
        return dataclasses.replace(self, stamps=stamps, values=values)

    def without(self, begin: float, end: float) -> Stream:
        """Return the stream without the poses between two times, s."""
        stamps, values = dict(self.stamps), dict(self.values)
        for source in (Source.CHASER, Source.TARGET):
            t = self.times(source)
            kept = (t < begin) | (t >= end)
            stamps[source], values[source] = stamps[source][kept], values[source][kept]
        return dataclasses.replace(self, stamps=stamps, values=values)

    def measurements(self) -> Iterator[Measurement]:
        """Yield the measurements in the order of their stamps."""
        stamps = np.concatenate([self.stamps[source] for source in Source])
        sources = np.concatenate([np.full(self.stamps[s].size, i) for i, s in enumerate(Source)])
        rows = [row for source in Source for row in self.values[source].tolist()]
        names = tuple(Source)
        for i in np.argsort(stamps, kind="stable").tolist():
            yield names[sources[i]], int(stamps[i]), tuple(rows[i])


@functools.cache
def exact_path(
    name: str, rate: float, *, is_clamped: bool
) -> tuple[Scene, CaptureStatus, np.ndarray]:
    """Return a scene, its verdict and its samples from the release on."""
    scene_name, changes = SCENES[name]
    heavy = ("target.mass=1e7", "target.inertia=1e7") if is_clamped else ()
    scene = load_scene(scene_name, (*changes, *heavy))
    status = next(status for status in simulate(scene).statuses if status.final)
    times = np.arange(0.0, status.t + AFTER, 1.0 / rate)
    return scene, status, Bench(scene).advance(times)


def stream(name: str, quality: Quality, rate: float, rng: np.random.Generator) -> Stream:
    """Return what cameras and encoders measure of a scene's run."""
    scene, verdict, samples = exact_path(name, rate, is_clamped=quality.is_clamped)
    held = round(HELD * rate)
    q = np.concatenate([np.repeat(samples["q"][:1], held, axis=0), samples["q"]])
    buffer = np.column_stack([samples["axial_stroke"], samples["torsion"]])
    buffer = np.concatenate([np.zeros((held, 2)), buffer])
    t = (np.arange(len(q)) - held) / rate
    pose = np.array([quality.position, quality.position, quality.angle])
    stamps, values = {}, {}
    for source, exact, sigma in (
        (Source.CHASER, q[:, 0:3], pose),
        (Source.TARGET, q[:, 5:8], pose),
        (Source.BUFFER, buffer, np.array([quality.stroke, quality.stroke / 0.2])),
    ):
        is_pose = source is not Source.BUFFER
        measured = exact + sigma * rng.standard_normal(exact.shape)
        if is_pose and quality.rounded:
            measured = np.round(measured / quality.rounded) * quality.rounded
        if source is Source.TARGET and quality.is_clamped:
            measured = np.repeat(exact[:1], len(exact), axis=0)
        is_kept = rng.uniform(size=t.size) >= quality.lost
        if is_pose:
            for begin in np.flatnonzero(rng.uniform(size=t.size) < quality.bursts / rate):
                is_kept[begin : begin + rng.integers(5, 21)] = False
        late = quality.jitter * rng.uniform(size=t.size)
        stamped = STAMP_OF_RELEASE + np.rint((t + late) * 1e9).astype(np.int64)
        stamps[source], values[source] = stamped[is_kept], measured[is_kept]
    return Stream(scene, verdict, stamps, values)


@dataclass(frozen=True)
class Injection:
    """A wrong place of a vehicle for some frames.

    ``offset`` is m, m and rad in the world; ``duration`` s, or a number of ``frames``.
    """

    source: Source
    begin: float
    offset: tuple[float, float, float]
    frames: int = 0
    duration: float = 0.0

    def into(self, clean: Stream) -> Stream:
        """Return the stream with the wrong frames."""
        times = clean.times(self.source)
        first = int(np.searchsorted(times, self.begin))
        last = first + self.frames
        if not self.frames:
            last = int(np.searchsorted(times, self.begin + self.duration))
        values = clean.values[self.source].copy()
        values[first:last] += np.array(self.offset)
        return clean.with_values(self.source, values)


def random_injection(
    clean: Stream, rng: np.random.Generator, frames: int = 0, duration: float = 0.0
) -> Injection:
    """Draw source, begin (every 20 ms), size (5 to 50 mm or 1.5 to 10 degrees) and direction."""
    first, last = -MARGIN, clean.verdict.t + MARGIN
    begin = first + 0.02 * rng.integers(0, round((last - first) / 0.02))
    source = (Source.CHASER, Source.TARGET)[rng.integers(2)]
    size, sign = rng.uniform(0.005, 0.05), rng.choice([-1.0, 1.0])
    turn = math.radians(rng.uniform(1.5, 10.0)) * rng.choice([-1.0, 1.0])
    offset = {
        "along": (sign * size, 0.0, 0.0),
        "across": (0.0, sign * size, 0.0),
        "turned": (0.0, 0.0, turn),
        "both": (sign * size, rng.choice([-1.0, 1.0]) * size, turn),
    }[rng.choice(["along", "across", "turned", "both"])]
    return Injection(source, float(begin), offset, frames, duration)


def first_difference(stream: Stream, other: Stream) -> float:
    """Return the stamp before which two streams are equal, ns; infinite if they are equal."""
    first = math.inf
    for source in Source:
        stamps = stream.stamps[source], other.stamps[source]
        n = min(map(len, stamps))
        differs = stamps[0][:n] != stamps[1][:n]
        differs |= (stream.values[source][:n] != other.values[source][:n]).any(axis=1)
        n_equal = int(np.argmax(differs)) if differs.any() else n
        first = min([first, *(each[n_equal] for each in stamps if n_equal < len(each))])
    return first


def evaluate(
    measured: Stream, detector: CaptureDetector | None = None, since: float = -math.inf
) -> tuple[CaptureStatus, CaptureDetector]:
    """Return the last status of a bench's trial, and the detector.

    A detector that is given has been measured with everything before the stamp ``since``, ns.
    """
    if detector is None:
        detector = CaptureDetector(measured.scene, is_released=False, zero=STAMP_OF_RELEASE)
    for source, stamp, values in measured.measurements():
        if stamp >= since:
            detector.measure(source, stamp, values)
    return detector.finish()[-1], detector


def evaluate_variants(
    measured: Stream, variants: Sequence[Stream]
) -> list[tuple[CaptureStatus, CaptureDetector]]:
    """Return what :func:`evaluate` does of a stream and of variants of it.

    Up to its first difference a variant is not evaluated again: the stream's detector is copied.
    """
    differences = [first_difference(measured, variant) for variant in variants]
    waiting = sorted(range(len(variants)), key=differences.__getitem__, reverse=True)
    detector = CaptureDetector(measured.scene, is_released=False, zero=STAMP_OF_RELEASE)
    found = {}

    def evaluate_next() -> None:
        n = waiting.pop()
        found[n] = evaluate(variants[n], copy.deepcopy(detector), differences[n])

    for source, stamp, values in measured.measurements():
        while waiting and differences[waiting[-1]] <= stamp:
            evaluate_next()
        detector.measure(source, stamp, values)
    while waiting:
        evaluate_next()
    return [(detector.finish()[-1], detector), *(found[n] for n in range(len(variants)))]


class Walk(NamedTuple):
    """What injections have done to the verdicts: numbers, and a line for each that changed."""

    outcomes: Counter[str]  # equal, wrong, undecided, or another time of the verdict
    lines: list[str]


def walk(
    quality: Quality,
    rate: float,
    rng: np.random.Generator,
    count: int,
    *,
    longest: int = 3,
    scenes: Iterable[str] = SCENES,
) -> Walk:
    """Inject 1 to ``longest`` wrong frames, or for 0: 0.05 to 0.3 s, ``count`` times in each scene.

    The verdict of the stream without them is the reference; its time may differ by 0.1 s.
    """
    outcomes, lines = Counter[str](), []
    for name in scenes:
        clean = stream(name, quality, rate, rng)
        injections = []
        for _ in range(count):
            frames = int(rng.integers(1, longest + 1)) if longest else 0
            duration = 0.0 if longest else float(rng.uniform(0.05, 0.3))
            injections.append(random_injection(clean, rng, frames, duration))
        (reference, _), *found = evaluate_variants(clean, [each.into(clean) for each in injections])
        if reference.state is not clean.verdict.state:
            outcomes["reference"] += 1
            lines.append(f"{name}, {rate:g} Hz without: {reference.label}, {reference.reason}")
        for injection, (status, detector) in zip(injections, found, strict=True):
            later = status.t - status.time_in_state - reference.t + reference.time_in_state
            if status.state is reference.state:
                outcome = "equal" if abs(later) <= 0.1 else "another time"
            else:
                outcome = "undecided" if status.label == "undecided" else "wrong"
            outcomes[outcome] += 1
            if outcome != "equal":
                lines.append(
                    f"{outcome}: {name}, {rate:g} Hz, {injection}: {status.label}, "
                    f"{status.reason}, {later:+.3f} s; {detector.counts.text}"
                )
    return Walk(outcomes, lines)
