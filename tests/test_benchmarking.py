"""The benchmark: its references, and that it says what it found, failures too."""

import csv
import dataclasses
import itertools
import math
import subprocess
import sys
import time

import numpy as np
import pytest

from benchmarks import costs, programs, speed
from benchmarks.engines import cvode, floor, own
from benchmarks.machine import OthersAtWork
from benchmarks.page import measured
from benchmarks.plots import Point, chosen
from benchmarks.reference import load_reference
from benchmarks.references.generate import REFERENCES
from benchmarks.speed import measure, save
from benchmarks.trial import Errors, Progress, Trial, errors
from capture_sim import load_scene, simulate


@pytest.mark.parametrize("name", REFERENCES)
@pytest.mark.parametrize("method", ["dop853", "dopri5"])
def test_the_bench_agrees_with_the_references(name, method):
    """Another method, other equations, extended precision: see benchmarks/references."""
    reference = load_reference(name)
    scene_name, law = REFERENCES[name]
    changes = ["run.rtol=1e-12", f"run.method={method}", f"friction.law={law}"]
    scene = load_scene(scene_name, changes)
    result = simulate(scene, t_end=0.4, t_eval=np.array([t for t in reference.times if t < 0.4]))
    for k, t in enumerate(result.t):
        assert np.abs(result.q[k] - reference.q[reference.times.index(t)]).max() < 1e-9
    begun = [e.t for e in result.events if e.kind.label == "touch" and e.t <= 0.35]
    starts = reference.touches["start"]
    assert begun == pytest.approx(starts[starts <= 0.35], abs=1e-9)


def test_the_bare_loop_finds_the_touches_of_the_reference():
    scene = own.with_run(load_scene("paper_designed"), t_end=0.35, rtol=1e-9)
    job, read = floor.prepare(scene)
    found = errors(read(job()), load_reference("paper_designed").at(0.35))
    assert found.touches == 7
    assert found.position < 1e-8
    assert found.event_time < 1e-6


def test_a_run_with_more_touches_than_there_is_room_for_fails(monkeypatch):
    """Compiled code does not check where it writes: a run that chatters filled other memory."""
    monkeypatch.setattr(floor, "_ROOM", 6)
    job, read = floor.prepare(own.with_run(load_scene("paper_designed"), t_end=0.35, rtol=1e-9))
    assert read(job()).failure == "more than 6 touches"


@pytest.mark.parametrize(
    "name, changes", [("tilt_0", []), ("paper_designed", ["friction.law=none"])]
)
def test_the_bare_loop_refuses_a_scene_of_which_it_lacks_a_part(name, changes):
    with pytest.raises(ValueError, match="the floor has"):
        floor.prepare(load_scene(name, changes))


@pytest.fixture(scope="module")
def results():
    """A quick benchmark that runs each trial once."""
    once = (dataclasses.replace(programs.QUICK[0], rounds=1),)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programs, "QUICK", once)
        return measure(True, Progress())


@pytest.mark.long
def test_a_quick_benchmark_writes_its_page_and_every_trial(results, tmp_path, drawn):
    save(results, tmp_path)
    page = (tmp_path / "benchmark.md").read_text(encoding="utf-8")
    assert "capture_sim needs" in page
    with (tmp_path / "benchmark" / "trials.csv").open(encoding="utf-8") as file:
        trials = list(csv.DictReader(file))
    names = {trial["program"] for trial in trials}
    assert {"capture_sim dop853", "bare C++ loop", "SciPy DOP853"} < names
    for trial in trials:
        # a trial has its error and its cost, or the reason why not
        is_measured = trial["position_error_m_or_rad"] != "" and float(trial["least_s"]) > 0.0
        assert is_measured or trial["failure"]
    ours = [t for t in trials if t["program"] == "capture_sim dop853"]
    assert float(ours[-1]["position_error_m_or_rad"]) < 1e-9
    assert (tmp_path / "benchmark" / "work_precision.svg").stat().st_size > 10_000


def test_speed_is_drawn_of_both_methods_here_and_of_the_fastest_of_each_other_kind():
    fast, slow = (("CVODE BDF", 1.0), ("SciPy RK45", 3.0)), (("CVODE Adams", 2.0),)
    rows = [*fast, *slow, ("capture_sim dop853", 1.0), ("capture_sim dopri5", 9.0)]
    points = [Point(name, 0.35, seconds, 1e-7, 1e-6) for name, seconds in rows]
    inaccurate = Point("CVODE Adams", 0.35, 0.1, 1e-3, 1e-6)
    miscounted = Point("CVODE Adams", 0.35, 0.1, 1e-9, math.nan)
    drawn = chosen([*points, inaccurate, miscounted])
    names = ["capture_sim dop853", "capture_sim dopri5", "CVODE BDF", "SciPy RK45"]
    assert [settings[0].program for settings in drawn] == names


def test_a_run_with_other_touches_or_late_events_does_not_count():
    """Both errors must be within the level, at the setting and at all tighter ones."""
    truth, level = load_reference("paper_designed").at(0.35), programs.Level(1e-6, 1e-5)

    def trial(position, event_time, seconds):
        found = Errors(position=position, event_time=event_time)
        return Trial("one", "rtol", None, "own", truth, seconds=[seconds], errors=found)

    wrong_touches, late = trial(1e-9, math.nan, 1.0), trial(1e-9, 1e-4, 1.0)
    good, slow = trial(1e-7, 1e-6, 2.0), trial(1e-8, 1e-7, 4.0)
    assert programs.best([wrong_touches, good, slow], level) is good
    assert programs.best([late, good, slow], level) is good
    assert programs.best([good, late, slow], level) is slow
    assert programs.best([good, slow, wrong_touches], level) is None


def test_a_page_is_not_written_on_a_busy_machine(results, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(speed, "measure", lambda *_: dataclasses.replace(results, others=0.5))
    assert speed.main(["--out", str(tmp_path)]) == 1
    assert "0.50 cores busy" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not cvode.version(), reason="scikit-sundae is not installed")
@pytest.mark.parametrize("method", cvode.METHODS)
def test_cvode_finds_the_touches_of_the_reference(method):
    scene = own.with_run(load_scene("paper_designed"), t_end=0.35, rtol=1e-9)
    job, read = cvode.prepare(scene, method)
    found = errors(read(job()), load_reference("paper_designed").at(0.35))
    assert found.touches == 7
    assert found.position < 1e-7
    assert found.event_time < 1e-5


@pytest.mark.parametrize("others, trusted", [(0.02, True), (0.5, False), (math.nan, False)])
def test_a_page_measured_on_a_busy_machine_says_so_at_its_top(results, others, trusted):
    found = measured(dataclasses.replace(results, others=others))
    assert found["machine"].startswith("**Measured on a busy machine") is not trusted


def test_a_part_costs_only_what_can_be_told_from_zero(results):
    """A clock that drifts and jitters: a difference of 5 us is found, one of zero is not shown."""
    noise, drift = np.random.default_rng(1), itertools.count()

    def job(extra):
        return lambda: 1e-3 + extra + 1e-7 * next(drift) + 2e-5 * noise.random()

    slower = costs.in_pairs(job(5e-6), job(0.0), 101)
    assert slower.is_told_from_zero
    assert slower.low < 5e-6 < slower.high
    equal = [costs.in_pairs(job(0.0), job(0.0), 101).is_told_from_zero for _ in range(40)]
    assert sum(equal) <= 6  # 5 % of them
    nothing = costs.Difference(1e-9, -1e-8, 1e-8)
    row = dataclasses.replace(results.parts[0], run=nothing, free=slower)
    text = measured(dataclasses.replace(results, parts=[row]))["parts"].splitlines()[2]
    cells = [cell.strip() for cell in text.strip("|").split("|")]
    assert cells[1].startswith("+")
    assert cells[3] == "-"


def test_the_machine_tells_others_work_from_its_own():
    others = OthersAtWork()
    burn = "sum(range(10**7))"
    before = time.process_time()
    while time.process_time() - before < 0.3:
        sum(range(10**5))
    own = others.cores()
    others = OthersAtWork()
    with subprocess.Popen([sys.executable, "-c", f"while True: {burn}"]) as process:
        time.sleep(0.5)
        beside = others.cores()
        process.kill()
    assert own >= -0.05
    assert beside > 0.2
