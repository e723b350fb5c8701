"""Where runs are done: answers in order, and lost workers in a line; what a run to a verdict is."""

import math
from types import SimpleNamespace

import pytest

from capture_sim import load_scene, simulate
from capture_sim.studies.evaluate.executors import ExecutorError, InProcess, answers, open_executor
from capture_sim.studies.evaluate.outcome import run_to_end, run_to_verdict


def test_run_to_verdict_is_the_whole_runs_verdict():
    for name in ("paper_designed", "paper_undamped", "paper_case_1", "tilt_p10"):
        whole = simulate(load_scene(name))
        final = next(status for status in whole.statuses if status.final)
        short = run_to_verdict(whole.scene)
        assert (short.verdict, short.t, short.reason) == (final.label, final.t, final.reason)
        before = whole.touches[whole.touches["start"] <= final.t]
        assert short.loads["max_normal_force"] == pytest.approx(
            before["peak_force"].max(), rel=1e-12
        )
        assert short.first_touch == whole.summary["first_contact_time"]
        # the extremes are of the motion, up to a fifth of a second later than the verdict
        sampled = whole.samples[whole.t <= final.t]["tip_distance"].min()
        later = whole.samples[whole.t <= final.t + 0.2]["tip_distance"].min()
        assert run_to_end(whole.scene).loads == whole.loads
        assert (
            later - 0.2 * 1e-3 < short.loads["nearest_distance"] <= sampled
        )  # 0.2 m/s for a sample's interval


def test_answers_come_back_in_order():
    with open_executor(2) as executor:
        reported = []
        found = answers(executor, math.sqrt, [4.0, 9.0, 16.0], lambda *done: reported.append(done))
        assert list(found) == [2.0, 3.0, 4.0]
        assert reported == [(1, 3), (2, 3), (3, 3)]


def test_a_cluster_that_is_not_there_is_said_in_a_line(capsys):
    pytest.importorskip("distributed", reason="Dask is optional: the extra cluster")
    with (
        pytest.raises(ExecutorError, match="must be an address"),
        open_executor(scheduler="nowhere"),
    ):
        pass


def test_a_worker_that_the_cluster_gave_up_is_one_line():
    dask = pytest.importorskip("distributed")

    def fail(_):
        raise dask.scheduler.KilledWorker("run-7", SimpleNamespace(address="tcp://127.0.0.1:1"), 3)

    with pytest.raises(ExecutorError, match=r"^the workers were lost \(.*\)$") as lost:
        list(answers(InProcess(), fail, [1]))
    assert "\n" not in str(lost.value)
