"""What the sensors of a scene make of the truth."""

import math
from itertools import chain

import numpy as np
import pytest

from capture_sim import load_scene, simulate
from capture_sim.dynamics.bench import Bench
from capture_sim.messages.convert import Messages, RunDescription
from capture_sim.messages.telemetry import BenchTelemetry
from capture_sim.messages.topics import CHASER_POSE, LOAD_CELL, TARGET_POSE
from capture_sim.recording.offline import PUBLISHERS
from capture_sim.run.sensors import SimulatedSensors, low_pass

BOTH = ["sensors.motion_capture={}", "sensors.load_cell={}", "sensors.seed=7"]
QUIET = ["sensors.load_cell={bandwidth: 1e+5}"]


def readings(result, scene=None):
    sensors = SimulatedSensors(result.scene if scene is None else scene)
    return [sensors.read(sample) for sample in result.samples]


@pytest.fixture(scope="module")
def free():
    """Floating vehicles, a long run of touches."""
    return simulate(load_scene("paper_designed", QUIET), t_end=1.0)


@pytest.fixture(scope="module")
def bench():
    return simulate(load_scene("tilt_m10", [*BOTH, *QUIET]))


def test_sensors_change_nothing_but_what_is_measured(bench):
    without = simulate(load_scene("tilt_m10"))
    assert bench.samples.tobytes() == without.samples.tobytes()
    assert bench.verdict == without.verdict


def test_the_load_cell_feels_the_whole_impulse_however_short_the_touches(free):
    """Its readings times the interval add up to the momentum that the target has gained."""
    read = np.array([r.wrench for r in readings(free)])
    dt = 1.0 / free.scene.run.state_rate
    theta = free.q[:, 7]
    fx = np.cos(theta) * read[:, 0] - np.sin(theta) * read[:, 1]
    fy = np.sin(theta) * read[:, 0] + np.cos(theta) * read[:, 1]
    gained = free.v[-1, 5:8] - free.v[0, 5:8]
    # at 100 kHz the filter hands on a mean within its interval
    mass, inertia = free.scene.target.mass, free.scene.target.inertia
    assert fx.sum() * dt == pytest.approx(mass * gained[0], rel=1e-4)
    assert fy.sum() * dt == pytest.approx(mass * gained[1], rel=1e-4)
    assert read[:, 2].sum() * dt == pytest.approx(inertia * gained[2], rel=1e-9)
    # the forces at the samples miss most of the chatter
    at_samples = -free.samples["contact_force"][:, 0].sum() * dt
    assert abs(at_samples - mass * gained[0]) > 1e-3 * mass * abs(gained[0])


def test_the_load_cell_agrees_with_the_contact_while_it_changes_slowly(bench):
    """On the floor too, where the supports take a part: in the latch, at rest and moving."""
    read = np.array([r.wrench for r in readings(bench)])
    samples = bench.samples
    force = -(samples["contact_force"] + samples["latch_force"])
    theta = samples["q"][:, 7]
    true = np.column_stack(
        [
            np.cos(theta) * force[:, 0] + np.sin(theta) * force[:, 1],
            np.cos(theta) * force[:, 1] - np.sin(theta) * force[:, 0],
        ]
    )
    late = samples["t"] > samples["t"][-1] - 1.5
    # the reading is the mean over the last interval: compare with the mean of its ends
    middle = 0.5 * (true[1:] + true[:-1])[late[1:]]
    error = read[1:, :2][late[1:]] - middle
    assert np.abs(middle).max() > 0.1
    assert np.abs(error).max() < 0.05 * np.abs(middle).max() + 2e-3


@pytest.mark.parametrize("order, slope", [("first", 1), ("second", 2)])
def test_the_low_pass_has_half_the_power_at_its_bandwidth(order, slope):
    dt, bandwidth = 1e-4, 50.0

    def gain(frequency):
        a_filter = low_pass(order, bandwidth, dt)
        t = np.arange(20_000) * dt
        phase = 2 * math.pi * frequency * t
        out = np.array([a_filter(math.sin(p)) for p in phase])
        settled = t > 1.0
        c = 2 * np.mean(out[settled] * np.exp(-1j * phase[settled]))
        return abs(c)

    assert gain(1.0) == pytest.approx(1.0, rel=1e-3)
    assert gain(bandwidth) == pytest.approx(math.sqrt(0.5), rel=2e-3)
    assert gain(500.0) == pytest.approx(0.1**slope, rel=0.03)


@pytest.mark.parametrize("order", ["first", "second"])
def test_the_low_pass_passes_a_constant_and_is_stable_at_any_bandwidth(order):
    for bandwidth in (1e-3, 10.0, 1e7):
        a_filter = low_pass(order, bandwidth, 1e-3)
        out = [a_filter(2.0) for _ in range(5000)]
        assert max(out) < 2.0 * 1.05
        if bandwidth > 1.0:
            assert out[-1] == pytest.approx(2.0, rel=1e-9)


def test_noise_has_the_scatter_that_was_asked_for(bench):
    read = readings(bench)
    poses = np.array([(*r.chaser, *r.target) for r in read if r.chaser is not None])
    assert len(poses) == len(bench.samples[::10])
    q = bench.q[::10]
    error = poses - q[:, [0, 1, 2, 5, 6, 7]]
    part = bench.scene.sensors.motion_capture
    wanted = [part.position_noise, part.position_noise, part.heading_noise] * 2
    n = len(error)
    assert np.abs(error.mean(axis=0) / wanted).max() < 4 / math.sqrt(n)
    assert error.std(axis=0) == pytest.approx(wanted, rel=4 / math.sqrt(2 * n))
    correlation = np.corrcoef(error.T) - np.eye(6)
    assert np.abs(correlation).max() < 5 / math.sqrt(n)


def test_each_sensor_has_noise_of_its_own(bench):
    """Another sensor taken away does not change what this one reads; another seed does."""
    both = readings(bench)
    alone = load_scene("tilt_m10", ["sensors.motion_capture={}", "sensors.seed=7"])
    other = load_scene("tilt_m10", ["sensors.motion_capture={}", "sensors.seed=8"])
    assert [r.chaser for r in readings(bench, alone)] == [r.chaser for r in both]
    assert readings(bench, other)[0].chaser != both[0].chaser


def stream(scene, sizes):
    """What the simulator sends of the sensors, with the run cut into blocks of these sizes."""
    made = Messages()
    telemetry = BenchTelemetry(made, scene, RunDescription.of(scene, "a run", PUBLISHERS))
    bench, first, sent = Bench(scene), 0, []
    for k in range(10_000):
        size = sizes[k % len(sizes)]
        samples = bench.advance(bench.times(first, size))
        for topic, _, data in chain.from_iterable(telemetry.block(samples)):
            if topic in (CHASER_POSE, TARGET_POSE, LOAD_CELL):
                sent.append((topic.name, data))
        first += size
        if bench.done:
            return sent
    raise AssertionError("the run does not end")


def test_readings_do_not_depend_on_how_the_run_is_cut():
    scene = load_scene("paper_designed", [*BOTH, "run.t_end=0.5", "sensors.motion_capture.rate=50"])
    whole = stream(scene, [100_000])
    assert whole == stream(scene, [1, 7, 100])
    names = [name for name, _ in whole]
    assert names.count(CHASER_POSE.name) == names.count(TARGET_POSE.name) == 26
    assert names.count(LOAD_CELL.name) == 501


def test_a_scene_without_sensors_sends_none():
    assert stream(load_scene("paper_designed", ["run.t_end=0.1"]), [100]) == []


def test_motion_capture_is_what_the_detector_sees():
    result = simulate(load_scene("tilt_0", ["sensors.motion_capture={rate: 200}"]))
    times = [status.t for status in result.statuses[:-1]]
    assert np.diff(times) == pytest.approx(0.005)
    assert result.verdict == simulate(load_scene("tilt_0")).verdict
    error = [
        status.axial_offset - result.samples["tip_axial"][round(status.t * 1000)]
        for status in result.statuses[:-1]
    ]
    # both vehicles' positions, and the buffer's swing between its 100 Hz
    assert np.std(error) == pytest.approx(math.sqrt(2.0) * 1e-3, rel=0.15)
