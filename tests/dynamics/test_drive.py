"""The one loop over a bench, and the sample times that it is given."""

import numpy as np
import pytest

from capture_sim import SceneError, SimulationError, load_scene, simulate
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.drive import drive


def test_pieces_add_up_to_the_run_whatever_their_size():
    scene = load_scene("tilt_m10", ["run.trace=true"])
    whole = simulate(scene)
    sizes = iter([1, 7, 100, *[50] * 500])
    bench = Bench(scene)
    pieces = list(drive(bench, block=lambda: next(sizes)))
    assert [piece.samples.size for piece in pieces[:3]] == [1, 7, 100]
    samples = np.concatenate([piece.samples for piece in pieces])
    assert samples.tobytes() == whole.samples.tobytes()
    assert np.concatenate([piece.trace for piece in pieces]).tobytes() == whole.trace.tobytes()
    kinds = [event.kind for piece in pieces for event in piece.events]
    assert kinds == [event.kind for event in whole.events]


def test_it_runs_to_the_end_behind_the_last_time():
    bench = Bench(load_scene("paper_designed", ["run.t_end=0.4"]))
    *_, last = drive(bench, np.array([0.1, 0.2]))
    assert bench.done
    assert last.samples.size == 0
    assert last.events[-1].t == 0.4


def test_nothing_is_computed_behind_the_piece_that_was_enough():
    bench = Bench(load_scene("paper_designed"))
    for piece in drive(bench, block=10):
        assert piece.samples["t"][-1] == 0.009
        break
    assert not bench.done
    assert bench.advance(np.array([0.01]))["t"] == 0.01


def test_a_run_that_must_stop_yields_what_it_has():
    bench = Bench(load_scene("tilt_0", ["run.max_steps=100", "run.method=rk4"]))
    *_, last = drive(bench)
    assert isinstance(last.failure, SimulationError)
    assert 0 < last.samples.size < 4096


@pytest.mark.parametrize(
    "times, number, allowed",
    [
        ([-0.1, 1.0], "0 = -0.1 s", ">= 0 and <= 3"),
        ([0.2, 0.1], "1 = 0.1 s", "> 0.2 and <= 3"),
        ([0.1, 0.1], "1 = 0.1 s", "> 0.1"),
        ([0.1, np.nan], "1 = nan s", "finite"),
        ([0.1, np.inf], "1 = inf s", "<= 3"),
        ([0.0, 3.1], "1 = 3.1 s", "<= 3"),
        ([[0.0, 1.0]], "shape (1, 2)", "(n,)"),
        (["soon"], "sample times", "numbers"),
        ([10**400], "sample times", "numbers"),
    ],
)
def test_sample_times_are_ascending_finite_and_within_the_run(times, number, allowed):
    with pytest.raises(SceneError) as caught:
        simulate(load_scene("paper_designed"), t_eval=times)
    message = str(caught.value)
    assert "\n" not in message
    assert number in message
    assert allowed in message


def test_a_bench_is_not_asked_backwards():
    bench = Bench(load_scene("paper_designed"))
    bench.advance(np.array([0.1]))
    with pytest.raises(SceneError, match=r"0\.05 s: must be > 0\.1"):
        bench.advance(np.array([0.05]))
