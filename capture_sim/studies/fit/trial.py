"""A trial for the fit: its measurements up to the first hold, and the corresponding simulation.

Seven numbers of each trial are fitted: the target's pose relative to the chaser, the pose of both
vehicles on the floor, and the release.  Only derivatives by the first three need simulations.  A
common translation and rotation of both vehicles moves all poses exactly.  Release and sensor delays
only shift times, so their derivatives follow from the rates.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.memory import Memory
from capture_sim.errors import RecordingError, SceneError, SimulationError
from capture_sim.run.run import Run
from capture_sim.run.series import PARTS, Series
from capture_sim.run.touches import Touches
from capture_sim.scene.parts import Scene
from capture_sim.scene.paths import with_values
from capture_sim.studies.compare.frame import NO_FRAME, Frame, in_frame_of_scene
from capture_sim.studies.fit.impulse import MeasuredImpulse, impulse_of
from capture_sim.studies.fit.parameters import SENSOR_ERRORS

#: Numbers of a trial: pose of the target relative to the chaser, common pose, and release.
OWN = ("along", "across", "turned", "x", "y", "theta", "release")
#: Units of their coordinates: m, m, rad, m, m, rad, s.
OWN_SIZE = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3])
#: How many of them, the first ones, have derivatives that need simulations.
RELATIVE = 3
POSES = ("chaser", "target")
#: Topic whose first message after the release with the value True ends the trial.
HOLD = "/launcher/hold"
#: Time before the recorded hold at which a trial ends, s: the launcher may act on the message
#: before the recorder writes it.
_HOLD_MARGIN = 0.01
#: Number of poses nearest to a log time that map it to stamps.
_NEAR = 15
#: A sensor of the buffer shows a contact if its change from the start exceeds this share of the
#: largest change, and this number of standard deviations.
_SHOWS, _SHOWS_NOISE = 0.03, 8.0
#: Residual, in units of noise, of a measured touch that the simulation lacks.
MISSING = 1e3


class MeasuredChannel(NamedTuple):
    """Measured values of one quantity, such as the stroke, in a trial."""

    name: str
    t: np.ndarray  # (n,), s since the assumed release, ascending
    values: np.ndarray  # (n, m), SI
    sigma: np.ndarray  # (m,), standard deviations


class SimulatedMotion(NamedTuple):
    """Simulated motion of a trial at the measured times, shifted by release and sensor delays.

    It is in the frame of the scene.  The trial's common pose, and scales and offsets of sensors,
    are not yet applied; see :func:`view`.
    """

    values: tuple[np.ndarray, ...]  # (n, m) of each channel
    rates: tuple[np.ndarray, ...]  # (n, m) of each; zero before the release
    touches: np.ndarray  # (k,) of dtype TOUCH, by start
    impulse: np.ndarray = np.zeros(2)  # N s, of the trial's ``impulse``


@dataclass(frozen=True)
class FittedTrial:
    """A trial prepared for a fit: its scene, measurements, contact and end."""

    name: str
    scene: Scene  # with the launch as commanded
    channels: tuple[MeasuredChannel, ...]
    contact: float  # measured first contact, s; infinite without a contact
    end: float  # s, end of the measurements used
    cut: float  # s, first hold after the release; infinite without a hold
    is_release_fitted: bool
    touches: Touches | None = None
    frame: Frame = NO_FRAME  # what brought the poses into the scene's frame
    impulse: MeasuredImpulse | None = None  # of the contact, where its touches are not resolved

    @property
    def size(self) -> int:
        """Number of residuals: measured values, and those of the force."""
        return sum(channel.values.size for channel in self.channels) + self.force_rows

    @property
    def sensors(self) -> set[str]:
        """Names of the quantities that are measured, with ``force`` if it is used."""
        return {channel.name for channel in self.channels} | (
            {"force"} if self.force_rows else set()
        )

    @property
    def touch_rows(self) -> int:
        """Number of residuals of touches, two of each: time and strength."""
        return 0 if self.touches is None else 2 * self.touches.start.size

    @property
    def force_rows(self) -> int:
        """Number of residuals of the force: those of touches, then two of the impulse."""
        return self.touch_rows + (0 if self.impulse is None else 2)

    def until(self, t: float) -> FittedTrial:
        """Return the trial with the measurements up to a time, s.

        Unless that is the whole trial, what its force shows is left out.
        """
        if t >= self.end:
            return self
        kept = tuple(
            channel._replace(t=channel.t[channel.t <= t], values=channel.values[channel.t <= t])
            for channel in self.channels
        )
        return dataclasses.replace(self, channels=kept, touches=None, impulse=None)

    def with_noise(self, sigma: Mapping[str, np.ndarray]) -> FittedTrial:
        """Return the trial with other standard deviations of the noise, (m,) by channel, SI.

        Channels that ``sigma`` lacks keep theirs.
        """
        channels = tuple(c._replace(sigma=sigma.get(c.name, c.sigma)) for c in self.channels)
        return dataclasses.replace(self, channels=channels)


def trial_of(
    run: Run,
    *,
    touches: Touches | None = None,
    has_impulse: bool = False,
    until: float = math.inf,
    is_release_fitted: bool = True,
) -> FittedTrial:
    """Return a run as a trial that can be fitted, its poses in the frame of its scene.

    Parameters
    ----------
    run
        The measured run.
    touches
        Its first touches; None to fit without them.
    has_impulse
        True to fit the impulse of the contact if there are no touches.
    until
        End of the measurements that are used, s.  They end earlier if the launcher commands the
        driver to hold the chaser again (topic launcher/hold), or if the scene's run is shorter.
    is_release_fitted
        False if the release is known exactly.

    Raises
    ------
    RecordingError
        The run has no poses of a vehicle before the end.
    SceneError
        All measurements have the same time.
    """
    name = run.origin.path or run.name
    run, frame = in_frame_of_scene(run, run.scene)
    scene = launched(run)
    cut = hold_after_release(run)
    end = min(until, cut, scene.run.t_end)
    channels = []
    for quantity, parts in PARTS.items():
        series = run.measured(quantity)
        kept = series.t <= end
        if kept.any():
            values = series.values[kept].reshape(int(kept.sum()), -1)
            series = Series(series.t[kept], values)
            sigma = np.maximum(scatter(series), [part.noise for part in parts])
            channels.append(MeasuredChannel(quantity, series.t, values, sigma))
    for vehicle in POSES:
        if vehicle not in [channel.name for channel in channels]:
            raise RecordingError(
                f"{name}: contains no pose of the {vehicle} of the time asked for "
                f"(/motion_capture/{vehicle} or /{vehicle}/odom)"
            )
    if len({float(t) for channel in channels for t in (channel.t[0], channel.t[-1])}) < 2:
        raise SceneError(f"{name}: measurements of one instant: must be of two or more")
    if touches is not None:
        touches = touches.of(touches.start <= end)
        touches = touches if touches.start.size else None
    last = max(float(channel.t[-1]) for channel in channels)
    return FittedTrial(
        name=name,
        scene=scene,
        channels=tuple(channels),
        contact=_contact(channels),
        end=min(end, last),
        cut=cut,
        is_release_fitted=is_release_fitted,
        touches=touches,
        frame=frame,
        impulse=impulse_of(run, end) if has_impulse and touches is None else None,
    )


def resolved(touches: Touches, scene: Scene) -> Touches | None:
    """Return the touches, or None if their force was sampled too slowly to find all of them.

    The simulated touches of the scene give the durations that the samples must resolve.
    """
    bench = Bench(scene)
    bench.advance(np.zeros(0))
    met = bench.touches[np.argsort(bench.touches["start"], kind="stable")][: touches.start.size]
    return None if touches.may_miss(met["end"] - met["start"]) else touches


def launched(run: Run) -> Scene:
    """Return the scene of a run with the hanging mass and drop height of its launch.

    The values come from the recorded launch, or else from the plan that the scene gives.  They are
    fixed, so that they do not change with the fitted parameters.
    """
    scene = run.scene
    if scene.string is None:
        return scene
    plan = run.plan or Bench(scene).plan
    string = dataclasses.replace(
        scene.string,
        impact_speed=None,
        hanging_mass=plan.hanging_mass,
        drop_height=plan.drop_height,
    )
    return dataclasses.replace(scene, string=string)


def hold_after_release(run: Run) -> float:
    """Return the time of the first hold after the release, s since the release, less 10 ms.

    It is infinite if the launcher did not hold the chaser again.  The message has no stamp, so its
    log time is converted to a stamp with the poses that were logged at nearly the same time.  Other
    poses would not do, because the offset changes by 0.1 s while the nodes start.
    """
    if run.is_exact or HOLD not in run.tables:
        return math.inf
    fields = run.tables[HOLD].fields
    if "data" not in fields:
        return math.inf
    t, holds = np.asarray(fields["t"], dtype=float), np.asarray(fields["data"], dtype=bool)
    released = np.flatnonzero(~holds)
    if not released.size:
        return math.inf
    again = np.flatnonzero(holds[released[0] :])
    if not again.size:
        return math.inf
    logged = float(t[released[0] + again[0]])
    poses = run.measured("chaser")
    if poses.arrival.size:
        near = np.argsort(np.abs(poses.arrival - logged), kind="stable")[:_NEAR]
        logged += float(np.median((poses.t - poses.arrival)[near]))
    return logged - _HOLD_MARGIN


def scatter(series: Series) -> np.ndarray:
    """Return the noise of each part of a smooth, evenly spaced series: standard deviations (m,).

    The third difference of white noise has 20 times its variance, and the third difference of a
    smooth motion is small.  The median excludes the bends at touches.
    """
    values = series.values.reshape(len(series.t), -1)
    if len(values) < 5:
        return np.zeros(values.shape[1])
    rough = np.abs(np.diff(values, n=3, axis=0))
    return np.asarray(np.median(rough, axis=0) / 0.6745 / math.sqrt(20.0))


def _contact(channels: list[MeasuredChannel]) -> float:
    """Return the time at which stroke or torsion first show a contact, s; infinite if none does."""
    first = math.inf
    for channel in channels:
        if channel.name in POSES or channel.t.size < 8:
            continue
        values = channel.values[:, 0]
        away = np.abs(values - np.median(values[: max(4, values.size // 20)]))
        shown = away > max(_SHOWS_NOISE * channel.sigma[0], _SHOWS * float(away.max()))
        lasting = shown[:-2] & shown[1:-1] & shown[2:]
        if lasting.any():
            first = min(first, float(channel.t[int(np.argmax(lasting))]))
    return first


class _OfThread(threading.local):
    """The memory of each thread: two threads may fit at the same time."""

    def __init__(self) -> None:
        self.memory = Memory()


_of_thread = _OfThread()


def simulate(
    trial: FittedTrial,
    values: Mapping[str, float],
    own: np.ndarray,
    sensors: Mapping[str, float],
) -> SimulatedMotion | None:
    """Simulate the motion of a trial; return None if it cannot be simulated with these values.

    Parameters
    ----------
    trial
        The trial.
    values
        Fields of the scene by path, SI.
    own
        (7,) numbers of the trial, in units of :data:`OWN_SIZE`.
    sensors
        Errors of sensors by name, SI.
    """
    along, across, turned, *_, release = (own * OWN_SIZE).tolist()
    scene = trial.scene
    target = scene.initial.target
    place = {
        "initial.target.x": target.x + along,
        "initial.target.y": target.y + across,
        "initial.target.theta": math.remainder(target.theta + turned, math.tau),
    }
    times = [
        np.maximum(channel.t - release - delay_of(channel.name, sensors), 0.0)
        for channel in trial.channels
    ]
    window = trial.impulse
    if window is not None:
        between = np.array([window.begin, window.end]) - release
        times.append(np.maximum(between, 0.0))
    grid = np.unique(np.concatenate(times))
    try:
        scene = with_values(scene, {**values, **place})
        if grid[-1] > scene.run.t_end:
            scene = with_values(scene, {"run.t_end": float(grid[-1])})
        bench = Bench(scene, memory=_of_thread.memory)
        samples = bench.advance(grid)
    except (SimulationError, SceneError):
        return None
    if not samples.size:
        return None
    q, v = samples["q"], samples["v"]
    last = len(samples) - 1  # a run that ended earlier stays where it is
    of_channels = []
    rates_of_channels = []
    for channel, t in zip(trial.channels, times, strict=False):
        index = np.minimum(np.searchsorted(grid, t), last)
        moving = (t > 0.0)[:, None]
        at, rate = _seen(channel.name, q[index], v[index])
        if channel.name == "stroke":
            at = at - scene.rest_length
        of_channels.append(at)
        rates_of_channels.append(rate * moving)
    touches = bench.touches
    touches = touches[np.argsort(touches["start"], kind="stable")]
    impulse = np.zeros(2)
    if window is not None:
        inside = (grid >= times[-1][0]) & (grid <= times[-1][1])
        index = np.minimum(np.flatnonzero(inside), last)
        impulse = window.of_samples(samples[index], grid[inside], scene)
    return SimulatedMotion(tuple(of_channels), tuple(rates_of_channels), touches, impulse)


def _seen(name: str, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values (n, m) and rates of a measured quantity, from ``q`` and ``v`` (n, 8)."""
    if name == "chaser":
        return q[:, 0:3], v[:, 0:3]
    if name == "target":
        return q[:, 5:8], v[:, 5:8]
    if name == "stroke":
        return q[:, 4:5], v[:, 4:5]
    return (q[:, 3] - q[:, 2])[:, None], (v[:, 3] - v[:, 2])[:, None]


def delay_of(name: str, sensors: Mapping[str, float]) -> float:
    """Return the sum of the delays in ``sensors`` that apply to a channel, s."""
    return sum(
        value
        for error, value in sensors.items()
        if SENSOR_ERRORS[error].kind == "delay" and name in SENSOR_ERRORS[error].channel
    )


class View(NamedTuple):
    """Simulated sensor readings of a trial, with the derivatives that need no simulation."""

    values: tuple[np.ndarray, ...]  # (n, m) of each channel
    rates: tuple[np.ndarray, ...]  # (n, m), derivatives by time
    turning: tuple[np.ndarray, ...]  # (n, m), derivatives by a common rotation
    gain: float = 1.0  # of the force's sensor


def view(
    trial: FittedTrial, motion: SimulatedMotion, own: np.ndarray, sensors: Mapping[str, float]
) -> View:
    """Return the sensor readings of a simulated motion, with common pose, scales and offsets.

    ``own`` (7,) has the numbers of the trial in units of :data:`OWN_SIZE`.  ``sensors`` has the
    errors by name, SI.
    """
    *_, x, y, theta, _ = (own * OWN_SIZE).tolist()
    chaser = trial.scene.initial.chaser
    c, s = math.cos(theta), math.sin(theta)
    R = np.array([[c, -s], [s, c]])
    R_turned = np.array([[-s, -c], [c, -s]])
    pivot = np.array([chaser.x, chaser.y])
    moved, rates, turning = [], [], []
    for channel, at, rate in zip(trial.channels, motion.values, motion.rates, strict=True):
        if channel.name not in POSES:
            scale = sensors.get(f"scale.{channel.name}", 1.0)
            moved.append(scale * at + sensors.get(f"offset.{channel.name}", 0.0))
            rates.append(scale * rate)
            turning.append(np.zeros_like(at))
            continue
        placed, turned, speed = at.copy(), np.ones_like(at), rate.copy()
        away = at[:, :2] - pivot
        placed[:, :2] = pivot + [x, y] + away @ R.T
        placed[:, 2] += theta
        turned[:, :2] = away @ R_turned.T
        speed[:, :2] = rate[:, :2] @ R.T
        scale = sensors.get(f"scale.{channel.name}", 1.0)
        if scale != 1.0:
            placed[:, :2] = placed[:1, :2] + scale * (placed[:, :2] - placed[:1, :2])
            speed[:, :2] *= scale
        off = [sensors.get(f"marker.{channel.name}.{axis}", 0.0) for axis in ("x", "y", "theta")]
        if any(off):  # the frame that is measured is not the body's
            along, across = _axes_of(placed[:, 2])
            placed[:, :2] += off[0] * along + off[1] * across
            turned[:, :2] += off[0] * across - off[1] * along
            speed[:, :2] += rate[:, 2:] * (off[0] * across - off[1] * along)
            placed[:, 2] += off[2]
        moved.append(placed)
        rates.append(speed)
        turning.append(turned)
    return View(tuple(moved), tuple(rates), tuple(turning), sensors.get("scale.force", 1.0))


def _axes_of(heading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors along and across bodies with these headings, (n, 2) each."""
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c, s], axis=1), np.stack([-s, c], axis=1)


def residuals(
    trial: FittedTrial, motion: SimulatedMotion, seen: View, release: float
) -> np.ndarray:
    """Return the residuals (n,): measured minus simulated values, in units of the noise.

    Those of the force come last.  ``release`` is in s.
    """
    parts = [
        ((channel.values - values) / channel.sigma).ravel()
        for channel, values in zip(trial.channels, seen.values, strict=True)
    ]
    return np.concatenate([*parts, *_force_residuals(trial, motion, release, seen.gain)])


def _force_residuals(
    trial: FittedTrial, motion: SimulatedMotion, release: float, gain: float
) -> list[np.ndarray]:
    """Return the residuals of times and strengths of the touches, and of the impulse."""
    touches, whole = trial.touches, trial.impulse
    if whole is not None:
        return [(whole.value - gain * motion.impulse) / whole.sigma]
    if touches is None:
        return []
    met = motion.touches[motion.touches["peak_force"] >= touches.threshold]
    n, count = min(touches.start.size, met.size), touches.start.size
    late, strength = np.full(count, MISSING), np.full(count, MISSING)
    off = touches.start[:n] - release - met["start"][:n]
    if n and not touches.is_delay_known:
        off = off - off.mean()  # the delay that fits best
    late[:n] = off / touches.start_noise
    expected = met["impulse" if touches.strength == "impulse" else "peak_force"][:n]
    measured = getattr(touches, touches.strength)[:n]
    gain = gain if touches.spacing > 0.0 else 1.0  # peaks that are counted are no sensor's
    strength[:n] = (measured - gain * expected) / touches.strength_noise[:n]
    return [late, strength]


def exact_columns(trial: FittedTrial, seen: View) -> np.ndarray:
    """Return the derivatives (n, 4) of the residuals by x, y, theta and release of the trial.

    These numbers are in units of :data:`OWN_SIZE`.  No simulation is needed.
    """
    columns = []
    for k in range(4):
        parts = []
        for channel, rate, turned in zip(trial.channels, seen.rates, seen.turning, strict=True):
            change = np.zeros_like(rate)
            if k == 3:
                change = -rate
            elif channel.name in POSES:
                if k == 2:
                    change = turned
                else:
                    change[:, k] = 1.0
            parts.append((-change * OWN_SIZE[RELATIVE + k] / channel.sigma).ravel())
        touch = np.zeros(trial.force_rows)
        if k == 3 and trial.touches is not None and trial.touches.is_delay_known:
            touch[: trial.touch_rows // 2] = -OWN_SIZE[-1] / trial.touches.start_noise
        columns.append(np.concatenate([*parts, touch]))
    return np.stack(columns, axis=1)


def sensor_column(trial: FittedTrial, motion: SimulatedMotion, seen: View, name: str) -> np.ndarray:
    """Return the derivative (n,) of the residuals by the sensor error with a name, in SI units."""
    error = SENSOR_ERRORS[name]
    parts = []
    for channel, at, values, rate in zip(
        trial.channels, motion.values, seen.values, seen.rates, strict=True
    ):
        change = np.zeros_like(values)
        if channel.name in error.channel:
            if error.kind == "delay":
                change = -rate
            elif error.kind == "offset":
                change += 1.0
            elif error.kind == "marker":
                axis = name.rpartition(".")[2]
                if axis == "theta":
                    change[:, 2] = 1.0
                else:
                    change[:, :2] = _axes_of(values[:, 2])[axis == "y"]
            elif channel.name in POSES:
                change[:, :2] = values[:, :2] - values[:1, :2]
            else:
                change = at
        parts.append((-change / channel.sigma).ravel())
    by_force = np.zeros(trial.force_rows)
    if "force" in error.channel:
        # the residuals are straight in the gain
        gained = [_force_residuals(trial, motion, 0.0, gain) for gain in (1.0, 0.0)]
        by_force = np.subtract(*map(np.concatenate, gained)) if trial.force_rows else by_force
    return np.concatenate([*parts, by_force])
