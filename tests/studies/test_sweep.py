"""Sweeps: what is drawn is run, one row is one run, statistics, files, and executors."""

import json
import math
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from cases import cases
from pandas.testing import assert_frame_equal
from scipy import stats

import capture_sim
from capture_sim import SceneError, load_scene, simulate
from capture_sim.base.files import whole_file
from capture_sim.base.journal import Journal
from capture_sim.cli import main
from capture_sim.dynamics.samples import EXTREMES, TOUCH, Extremes
from capture_sim.errors import RecordingError
from capture_sim.recording.sweep_file import is_complete, read_cases, write_sweep
from capture_sim.run.loads import LOADS, loads_of
from capture_sim.scene import paths
from capture_sim.scene.approach import approach_of, placed
from capture_sim.studies.evaluate import sweep as module
from capture_sim.studies.evaluate.dispersion import (
    capture_probability,
    complete_samples,
    limit_probability,
    margin_at,
    quantiles,
    rank_correlations,
    sobol_indices,
    success_probability,
    wilks_runs,
)
from capture_sim.studies.evaluate.executors import InProcess, open_executor
from capture_sim.studies.evaluate.limits import exceeded, make_limits
from capture_sim.studies.evaluate.outcome import run_to_end
from capture_sim.studies.evaluate.sweep import Recipe, samples_of
from capture_sim.studies.vary.inputs import read_input
from capture_sim.studies.vary.sampling import make_samples
from capture_sim.viewing.sweep import draw_sweep

HERE = InProcess()
SHORT = ["run.t_end=3"]


@pytest.fixture
def scenes_run(monkeypatch):
    """The scenes that a sweep in this process hands to the bench, in order; they are not run."""
    scenes = []

    def note(scene, *_):
        scenes.append(scene)
        raise SceneError("not run")

    monkeypatch.setattr(module, "Integration", note)
    return scenes


KINDS = {
    "span": {"buffer.c_A": "5:30:6"},
    "span with units": {"initial.target.theta": "-5 deg:5 deg:3"},
    "list": {"buffer.k_A": "0.4 N/mm, 500, 600"},
    "names": {"contact.law": "flores, lee_wang"},
    "array": {"chaser.mass": np.linspace(4.0, 6.0, 3)},
    "two axes": {"buffer.c_A": [5, 10], "buffer.k_T": "100:300:3"},
    "normal": {"buffer.k_A": "normal(500, 5%)"},
    "uniform": {"initial.chaser.y": "uniform(0, 5 mm)"},
    "triangular": {"contact.restitution": "triangular(0.3, 0.6, 0.9)"},
    "loguniform": {"buffer.k_A": "loguniform(50%, 200%)"},
    "truncated_normal": {"friction.mu": "truncated_normal(0.1, 0.05, 0, 0.2)"},
    "scipy by name": {"buffer.k_A": "weibull_min(2, 100, 500 N/m)"},
    "scipy frozen": {"buffer.k_A": stats.gamma(5.0, scale=100.0)},
    "values and draws": {"buffer.c_A": [5, 10], "buffer.k_A": "normal(500, 50)"},
    "nested": {"supports.chaser.c_rr": "uniform(1e-4, 1e-3)", "contact.tip.E": [2e11, 7e10]},
    "table": pd.DataFrame({"buffer.c_A": [5.0, 6.0], "initial.target.theta": ["1 deg", "2 deg"]}),
}


@pytest.mark.parametrize("vary", KINDS.values(), ids=KINDS)
def test_what_is_drawn_is_read_back_from_the_scene_that_is_run(vary, scenes_run):
    drawn = not isinstance(vary, pd.DataFrame) and any(
        hasattr(given, "ppf") or "(" in str(given) for given in vary.values()
    )
    for sample in ("random", "latin", "sobol") if drawn else ("random",):
        scenes_run.clear()
        options = {"runs": 8 if drawn else 0, "sample": sample, "edges": 3 if drawn else 0}
        table = capture_sim.sweep("tilt_0", vary, executor=HERE, **options)
        assert len(table) == len(scenes_run) > 1
        for (_, row), scene in zip(table.iterrows(), scenes_run, strict=True):
            for name in vary:
                assert paths.get(scene, name) == row[name]
        for name in vary:
            assert table[name].nunique() > 1


def test_an_approach_is_read_back_from_the_scene_that_is_run(scenes_run):
    vary = {
        "approach.angle": "-10 deg:10 deg:3",
        "approach.offset": "uniform(2 mm, 8 mm)",
        "approach.speed": [0.05, 0.2],
        "cone.R_c": "uniform(15 mm, 15.1 mm)",
    }
    table = capture_sim.sweep("tilt_p10", vary, runs=3, executor=HERE)
    assert len(table) == len(scenes_run) == 18
    names = ["approach.angle", "approach.offset", "approach.speed"]
    for (_, row), scene in zip(table.iterrows(), scenes_run, strict=True):
        found = approach_of(scene)
        assert [found.angle, found.offset, found.speed] == pytest.approx(
            row[names].tolist(), rel=1e-9, abs=1e-12
        )
        assert scene.cone.R_c == row["cone.R_c"]
        assert scene.rail is None
        assert scene.string is None


def test_approach_that_is_not_varied_is_that_of_the_scene(scenes_run):
    capture_sim.sweep("tilt_p10", {"approach.offset": [0.0, 0.005]}, executor=HERE)
    own = approach_of(load_scene("tilt_p10"))
    for scene, offset in zip(scenes_run, (0.0, 0.005), strict=True):
        found = approach_of(scene)
        assert [found.angle, found.offset, found.speed] == pytest.approx(
            [own.angle, offset, own.speed], abs=1e-12
        )


@pytest.mark.parametrize("name", ["tilt_0", "paper_designed"])
def test_a_row_is_the_run_that_simulate_makes(name):
    table = capture_sim.sweep(name, {"buffer.c_A": [5, 25]}, executor=HERE)
    for _, row in table.iterrows():
        result = simulate(name, {"buffer.c_A": row["buffer.c_A"], "run.rtol": 1e-6})
        assert row["verdict"] == result.verdict
        final = next(status for status in result.statuses if status.final)
        assert row["verdict_time"] == final.t
        for load in LOADS:
            assert row[load.key] == result.summary[load.key], load.key
            before = result.summary.get(f"{load.key}_before_latch")
            assert before is None or row[f"{load.key}_before_latch"] == before
        assert row["left_again"] == result.summary["left_again"]
        assert row["touches"] == result.summary["touches"]
        assert row["first_touch_time"] == result.summary["first_contact_time"]
        # of the samples at run.rate, a part of those of the summary
        assert 0.0 < row["energy_residual"] <= result.summary["energy_residual"]


def test_the_command_of_a_run_repeats_it_to_the_bit():
    """Also where the approach is varied only in part: the rest is the unchanged scene's."""
    scene = load_scene("tilt_p10", SHORT)
    vary = {"approach.angle": [0.1], "buffer.k_A": "normal(500, 5%)", "contact.law": "flores"}
    vary |= {"chaser.mass": [22.0], "approach.mouth_offset": [0.01]}
    samples = samples_of(scene, vary, 2)
    table = module.run_samples(scene, samples, executor=HERE)
    recipe = Recipe(scene, tuple(vary))
    for number, values in enumerate(samples.rows):
        alone = run_to_end(load_scene("tilt_p10", [*SHORT, *recipe.overrides_of(values)]))
        assert alone.loads["touches"] > 0
        assert table["verdict"][number] == alone.verdict
        loads = {name: math.nan if x is None else x for name, x in alone.loads.items()}
        row = table.loc[number, list(loads)].to_dict()
        assert row == pytest.approx(loads, rel=0, abs=0, nan_ok=True)


SMALL = {"approach.angle": "-20 deg:20 deg:3", "buffer.c_A": "uniform(5, 30)"}


def small(executor):
    return capture_sim.sweep("tilt_0", SMALL, SHORT, runs=5, executor=executor)


@pytest.fixture(scope="module")
def alone():
    return small(HERE)


def test_processes_threads_and_no_executor_give_the_same_table(alone):
    with open_executor(2) as executor:
        assert_frame_equal(small(executor), alone, check_exact=True)
    with ThreadPoolExecutor(2) as executor:
        assert_frame_equal(small(executor), alone, check_exact=True)
    assert_frame_equal(small(None), alone, check_exact=True)


@pytest.mark.long
def test_a_dask_cluster_gives_the_same_table(alone):
    distributed = pytest.importorskip("distributed", reason="Dask is optional: the extra cluster")
    local = {"n_workers": 1, "threads_per_worker": 1, "host": "127.0.0.1"}
    with (
        distributed.LocalCluster(**local, dashboard_address=None, processes=True) as cluster,
        open_executor(scheduler=cluster.scheduler_address) as executor,
    ):
        assert_frame_equal(small(executor), alone, check_exact=True)


def test_a_script_without_a_main_guard_uses_all_cores(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import capture_sim\nprint('begin')\n"
        "table = capture_sim.sweep('tilt_0', {'buffer.c_A': [5, 15]}, ['run.t_end=0.5'])\n"
        "print(table['verdict'].size)\n"
    )
    assert subprocess.check_output([sys.executable, script], text=True).split() == ["begin", "2"]


def test_mirrored_approaches_give_mirrored_loads():
    vary = {"approach.angle": [-0.2, 0.2], "approach.offset": [-0.01, 0.01]}
    table = capture_sim.sweep("tilt_0", vary, SHORT, executor=HERE)
    left, right = table.iloc[1], table.iloc[2]
    assert left["verdict"] == right["verdict"]
    assert left["max_normal_force_plus_y"] == pytest.approx(
        right["max_normal_force_minus_y"], rel=1e-4
    )


def test_draws_follow_their_distributions_and_the_seed():
    scene = load_scene("tilt_0")
    axes = [
        read_input(scene, "buffer.k_A", "normal(500, 5%)"),
        read_input(scene, "buffer.k_T", "loguniform(100, 400)"),
        read_input(scene, "contact.restitution", "triangular(0.3, 0.3, 0.9)"),
    ]
    for sample in ("latin", "sobol"):
        values = np.array(make_samples(axes, 1024, sample).rows).T
        assert values[0].mean() == pytest.approx(500.0, rel=1e-3)
        assert values[0].std() == pytest.approx(25.0, rel=0.02)
        assert np.median(values[1]) == pytest.approx(200.0, rel=0.01)
        assert values[2].mean() == pytest.approx(0.5, rel=0.01)
    first, again, other = (make_samples(axes, 50, "random", seed).rows for seed in (1, 1, 2))
    assert first == again != other
    for sample in ("random", "latin"):  # nor on the others, nor on their order
        alone = np.array(make_samples(axes[1:2], 50, sample, edges=5).rows)[:, 0]
        turned = np.array(make_samples(axes[::-1], 50, sample, edges=5).rows)[:, 1]
        assert np.array_equal(alone, turned)
    longer = make_samples(axes, 60, "random", 1).rows
    assert longer[:50] == first
    edged = make_samples(axes, 50, "random", 1, edges=200)
    assert edged.rows[:50] == first
    edge = axes[0].distribution.cdf([row[0] for row in edged.rows[50:]])
    assert edge.min() == pytest.approx(0.005)
    assert edge.max() == pytest.approx(0.995)
    assert np.mean((edge < 0.02) | (edge > 0.98)) > 0.35


@pytest.mark.parametrize("sample", ["random", "latin", "sobol"])
def test_correlated_draws_keep_their_distributions(sample):
    """Spearman's correlation of a Gaussian copula is 6 / pi asin(R / 2); a third is untouched."""
    scene = load_scene("tilt_0")
    texts = {
        "buffer.k_A": "normal(500, 5%)",
        "buffer.k_T": "loguniform(100, 400)",
        "friction.mu": "uniform(0, 0.3)",
    }
    axes = [read_input(scene, name, text) for name, text in texts.items()]
    correlations = {("buffer.k_T", "buffer.k_A"): 0.6}
    free = np.array(make_samples(axes, 4096, sample).rows).T
    found = np.array(make_samples(axes, 4096, sample, correlations=correlations).rows).T
    rank = stats.spearmanr(found[0], found[1]).statistic
    assert rank == pytest.approx(6.0 / math.pi * math.asin(0.3), abs=0.03)
    for values, axis in zip(found, axes, strict=True):
        assert stats.kstest(values, axis.distribution.cdf).pvalue > 1e-3
    assert np.array_equal(found[2], free[2])


def test_every_value_has_the_same_draws():
    table = capture_sim.sweep(
        "tilt_0",
        {"friction.mu": "uniform(0, 0.3)", "buffer.c_A": [5, 10]},
        ["run.max_steps=100"],
        runs=3,
        executor=HERE,
    )
    assert table["buffer.c_A"].tolist() == [5, 5, 5, 10, 10, 10]
    assert table["friction.mu"].tolist()[:3] == table["friction.mu"].tolist()[3:]
    assert set(table["verdict"]) == {"failed"}
    assert all("max_steps" in text for text in table["failure"])


def test_runs_that_cannot_be_computed_say_why_and_count_apart():
    table = capture_sim.sweep(
        "tilt_0", {"initial.target.x": [0.45, 0.9, -1e3]}, ["run.t_end=0.5"], executor=HERE
    )
    assert table["verdict"].tolist()[0] == "failed"
    assert "the tip starts" in table["failure"][0]
    assert np.isnan(table["max_torsion"][0])
    found = capture_probability(table)
    assert found.failed == (table["verdict"] == "failed").sum()
    assert found.computed == 3 - found.failed


def verdicts(captured, missed, failed=0):
    return pd.DataFrame(
        {"verdict": ["captured"] * captured + ["missed"] * missed + ["failed"] * failed}
    ).assign(left_again=False)


def test_probability_has_the_exact_interval():
    found = capture_probability(verdicts(50, 0, failed=7))
    assert (found.computed, found.failed, found.estimate, found.high) == (50, 7, 1.0, 1.0)
    assert found.low == pytest.approx(0.025 ** (1 / 50), rel=1e-12)
    found = capture_probability(verdicts(8, 2))  # tables of Clopper and Pearson
    assert (found.low, found.high) == (
        pytest.approx(0.4439, abs=1e-4),
        pytest.approx(0.9748, abs=1e-4),
    )
    assert np.isnan(capture_probability(verdicts(0, 0, failed=2)).estimate)


def test_limits_have_their_probabilities_margins_and_flags():
    """A table whose loads are 0.01 to 1.00 N: a limit of 0.8 N is met by 80 of 100 runs."""
    force = np.arange(1, 101) / 100.0
    table = pd.DataFrame({"verdict": ["captured"] * 90 + ["missed"] * 10, "left_again": False})
    table["max_normal_force"] = force
    table["max_torsion"] = force[::-1] * 1e-3
    limits = make_limits({"max_normal_force": 0.8, "max_torsion": "0.905 mrad"})
    found = limit_probability(table, limits[:1])
    exact = stats.beta.ppf(0.025, 80, 21), stats.beta.ppf(0.975, 81, 20)
    assert (found.met, found.computed, found.low, found.high) == (
        80,
        100,
        *map(pytest.approx, exact),
    )
    assert limit_probability(table, limits).met == 70
    assert success_probability(table, limits).met == 70
    assert success_probability(table, limits[1:]).met == 80
    assert margin_at(table, limits[0], 0.05) == pytest.approx(1 - np.quantile(force, 0.95) / 0.8)
    assert margin_at(table, limits[0], 0.0) == pytest.approx(-0.25)
    assert exceeded(limits, {"max_normal_force": 0.8, "max_torsion": 1e-3}) == ("max_torsion",)
    assert exceeded(limits, {"max_normal_force": None, "max_torsion": math.nan}) == ()


def test_the_command_reports_limits_and_flags_the_runs_that_exceed_them(tmp_path, capsys):
    out = tmp_path / "a.csv"
    vary = ["--vary=buffer.k_A=uniform(100, 900)", "--runs=12", "--set=run.t_end=3.5"]
    limits = ["--limit=max_axial_stroke_in_before_latch=7 mm", "--limit=max_normal_force=500"]
    assert main(["sweep", "tilt_0", *vary, *limits, "--workers=1", f"--out={out}"]) == 0
    printed = capsys.readouterr().out
    table = pd.read_csv(out, keep_default_na=False)
    too_long = table["max_axial_stroke_in_before_latch [m]"] > 7e-3
    met = 12 - too_long.sum()
    assert 0 < met < 12
    flags = np.where(too_long, "max_axial_stroke_in_before_latch", "")
    assert table["exceeded"].tolist() == flags.tolist()
    for limit, unit, n in (("7", "mm", met), ("500", "N", 12)):
        assert re.search(rf" {limit} +{unit} +{n} of 12", printed)
    assert re.search(r"1\.0000 +0\.7354 to 1\.0000", printed)  # Clopper and Pearson of 12 of 12
    assert (tmp_path / "a_loads.png").exists()
    assert main(["sweep", "tilt_0", *vary, "--limit=max_force=5", f"--out={out}"]) == 2
    assert "limit max_force" in capsys.readouterr().err


def test_captures_that_left_again_count_apart(tmp_path, capsys):
    """In the paper's case without a latch, the tip of every captured run leaves the zone again."""
    out = tmp_path / "a.csv"
    vary = ["--vary=buffer.c_A=uniform(12, 13)", "--runs=3", "--workers=1", f"--out={out}"]
    assert main(["sweep", "paper_designed", *vary]) == 0
    table = pd.read_csv(out)
    assert table["verdict"].tolist() == ["captured"] * 3
    assert table["left_again"].all()
    printed = capsys.readouterr().out
    assert "captured 3 of 3" in printed
    assert "captured and not left again 0 of 3" in printed


def test_intervals_of_quantiles_hold_as_often_as_they_say():
    generator, share, held = np.random.default_rng(5), 0.95, 0
    true = -math.log(1.0 - share)
    for _ in range(400):
        (found,) = quantiles(generator.exponential(size=200), [share])
        held += found.low <= true <= found.high
    assert 0.94 < held / 400 <= 1.0
    (few,) = quantiles(generator.exponential(size=20), [0.99])
    assert np.isnan(few.high)  # 20 runs do not bound it


def test_wilks_numbers():
    assert [wilks_runs(share) for share in (0.9, 0.95, 0.99, 0.9973)] == [29, 59, 299, 1109]
    assert [wilks_runs(0.95, failures=k) for k in (1, 2)] == [93, 124]


def test_indices_and_correlations_of_a_known_function():
    """Y = 4 a + 2 b + 0 c of independent uniform shares: S = 0.8, 0.2, 0."""
    scene, names = load_scene("tilt_0"), ["buffer.c_A", "contact.restitution", "friction.mu"]
    axes = [read_input(scene, name, "uniform(0, 1)") for name in names]
    samples = make_samples(axes, 512, "saltelli")
    table = pd.DataFrame(samples.rows, columns=names)
    y = 4.0 * table[names[0]] + 2.0 * table[names[1]]
    table = table.assign(verdict="captured", **{load.key: y for load in LOADS})
    found = sobol_indices(table, names, "max_torsion")
    assert found.first == pytest.approx([0.8, 0.2, 0.0], abs=0.02)
    assert found.total == pytest.approx([0.8, 0.2, 0.0], abs=0.02)
    table.loc[3, "max_torsion"] = math.nan  # its base sample is left out
    assert sobol_indices(table, names, "max_torsion").used == 511
    ranks = rank_correlations(table, names)["max_normal_force"]
    assert ranks.iloc[0] == pytest.approx(0.89, abs=0.03)
    assert abs(ranks.iloc[2]) < 0.1
    assert rank_correlations(table, names)["captured"].isna().all()


def test_an_approach_without_a_touch_is_run_to_its_verdict():
    """A tip that fits through the throat is captured untouched; one beside the cone misses."""
    table = capture_sim.sweep(
        "tilt_0",
        {"approach.offset": [0.0, 0.3], "approach.speed": [0.05]},
        ["cone.R_c=18 mm", "run.t_end=8"],
        executor=HERE,
    )
    assert table["verdict"].tolist() == ["captured", "missed"]
    assert table["touches"].tolist() == [0, 0]
    assert table["max_normal_force_before_latch"].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "tilt_m10"])
def test_an_experiment_is_the_approach_that_it_is(name):
    """Launched by the string along the rail, or placed before the touch at its speed.

    Placed, the buffer has not yet felt the rolling resistance: m_P a / k_A is 3 um.
    """
    launched = simulate(name)
    own = approach_of(launched.scene)
    assert own.angle == pytest.approx(math.radians({"0": 0, "p10": 10, "m10": -10}[name[5:]]))
    assert (own.offset, own.speed) == (pytest.approx(0.005), pytest.approx(0.1))
    near = simulate(placed(launched.scene, own), t_end=4.0)
    assert near.verdict == launched.verdict
    for key in ("impact_speed", "first_contact_duration", "first_contact_impulse"):
        assert near.summary[key] == pytest.approx(launched.summary[key], rel=2e-3)
    assert near.summary["first_contact_time"] == pytest.approx(2e-3 / own.speed, rel=2e-3)


# values that no field takes are drawn in tests/commands/test_arguments.py
BAD = [
    (
        {"buffer.force_table": "1,2"},
        "buffer.force_table: must be a single value, is a list; change",
    ),
    ({"buffer.cA": "1:2:3"}, r"buffer.cA: no number of tilt_0; did you mean buffer.c_A\?"),
    ({"mass": "1"}, "did you mean chaser.mass, target.mass or cylinder.mass"),
    ({"rail": "1"}, "rail: no number"),
    ({"approach.angel": "1"}, r"did you mean approach.angle\?"),
    ({"buffer.c_A": "5:30"}, "buffer.c_A = 5:30: must be LOW:HIGH:COUNT, .A,B,C., a distribution"),
    ({"buffer.c_A": "0,5:30:3"}, "must be LOW:HIGH:COUNT, .* in N s/m; decimals need a point"),
    ({"buffer.c_A": "5:30:0"}, "COUNT must be 1 to"),
    ({"buffer.c_A": "-5:30:3"}, "buffer.c_A = -5.0 N s/m: must be >= 0"),
    ({"buffer.c_A": []}, "must be 1 to"),
    ({"buffer.c_A": "1:2:9999", "buffer.k_A": "1:2:9999"}, "number of runs = 99980001: must be"),
    ({"buffer.k_A": "uniform(2, 1)"}, "must have a width > 0"),
    ({"initial.target.theta": "normal(100%, 10%)"}, "a percentage of 0 is 0"),
    ({"buffer.k_A": "poisson(3)"}, "must be a distribution of scipy.stats"),
    ({"approach.angle": "0,1", "initial.chaser.y": "0"}, "initial.chaser.y: must not vary with"),
    ({"approach.offset": "0", "approach.mouth_offset": "0"}, "must not vary with approach.offset"),
    ({"sensors.seed": "1,2"}, "sensors.seed: must not vary"),
    ({}, "one axis or more"),
    (pd.DataFrame({"k_A": [1], "buffer.c_A": [1]}), r"column k_A: .*did you mean buffer.k_A\?"),
    (pd.DataFrame({"Buffer.c_A": [1], "buffer.k_A": [1]}), "column Buffer.c_A: .* buffer.c_A"),
    (pd.DataFrame({"buffer.c_A": []}), "one row"),
    (pd.DataFrame({"buffer.c_A": [None, None]}), "row 0: buffer.c_A: has no value"),
]


@pytest.mark.parametrize("vary, message", BAD)
def test_what_cannot_be_varied_is_rejected_in_a_line_before_anything_runs(
    vary, message, scenes_run
):
    with pytest.raises(SceneError, match=message) as caught:
        capture_sim.sweep("tilt_0", vary, {"sensors.motion_capture.rate": 100}, executor=HERE)
    assert "\n" not in str(caught.value)
    assert not scenes_run


@pytest.mark.parametrize(
    "options, message",
    [
        ({"runs": 0}, "runs = 0: must be >= 1"),
        ({"runs": 100, "sample": "sobol"}, "a power of 2 with sobol"),
        ({"runs": 8, "sample": "saltelli"}, "two distributions or more"),
        ({"runs": 8, "sample": "grid"}, "must be one of random, latin, sobol, saltelli"),
        ({"runs": 8, "edges": -1}, "edges = -1"),
        ({"correlations": {("buffer.c_A", "buffer.k_A"): 0.5}}, "buffer.k_A is no distribution"),
        ({"correlations": {("buffer.c_A", "buffer.c_A"): 0.5}}, "must be two distributions"),
    ],
)
def test_wrong_designs_are_rejected(options, message):
    with pytest.raises(SceneError, match=message):
        options = {"runs": 2, **options}
        capture_sim.sweep("tilt_0", {"buffer.c_A": "uniform(5, 30)"}, executor=HERE, **options)


def test_correlations_that_contradict_each_other_are_rejected():
    names = ["buffer.c_A", "buffer.k_A", "buffer.k_T"]
    vary = dict.fromkeys(names, "uniform(5, 30)")
    pairs = {(names[0], names[1]): 0.9, (names[1], names[2]): 0.9, (names[0], names[2]): -0.9}
    with pytest.raises(SceneError, match="contradict each other"):
        capture_sim.sweep("tilt_0", vary, runs=2, correlations=pairs, executor=HERE)


def test_ctrl_c_keeps_the_rows_that_are_done(scenes_run):
    def interrupt(done, count):
        if done >= 40:
            raise KeyboardInterrupt

    with pytest.warns(UserWarning, match="interrupted: 40 of 100 runs are done"):
        table = capture_sim.sweep(
            "tilt_0", {"buffer.c_A": "1:30:100"}, executor=HERE, report=interrupt
        )
    whole = capture_sim.sweep("tilt_0", {"buffer.c_A": "1:30:100"}, executor=HERE)
    assert_frame_equal(table, whole[:40])


@pytest.mark.parametrize(
    "number, to_all",
    cases(few=[(signal.SIGINT, False)], all=[(signal.SIGINT, False), (signal.SIGTERM, True)]),
)
def test_a_command_that_is_ended_keeps_the_rows_and_says_so(number, to_all, tmp_path):
    """By Ctrl-C, or as a batch queue ends all processes of a job; it reports from 0.1 s on."""
    out = tmp_path / "t.csv"
    begin = "import sys; from capture_sim import cli; from capture_sim.commands import output; "
    begin += "output._PAUSE = 0.1; sys.exit(cli.main())"
    command = [sys.executable, "-u", "-c", begin, "sweep", "tilt_0", "--workers=2"]
    command += ["--vary=buffer.c_A=uniform(5, 30)", "--runs=50000", f"--out={out}"]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as run:
        for line in run.stderr:
            if line.startswith("sweep: "):
                assert "runs/s, about" in line
                break
        (os.killpg if to_all else os.kill)(run.pid, number)
        output, errors = run.communicate(timeout=600)
    assert run.returncode == 130
    assert f"of 50000 runs written to {out}" in errors
    assert "Traceback" not in errors
    done = len(pd.read_csv(out))
    assert f"{done} runs, seed 1" in output
    assert done > 20
    made_by = json.loads(out.with_name("t_made_by.json").read_text())
    assert (made_by["written"], made_by["runs"]) == (done, 50000)


def child_processes(pid):
    with suppress(OSError):
        return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return []


@pytest.mark.parametrize("children", cases(few=[1], all=[1, 4]))
def test_ctrl_c_while_workers_are_started_leaves_nothing_behind(children, tmp_path):
    """The terminal sends it to all processes of the command, whose first child is a tracker."""
    out = tmp_path / "t.csv"
    out.write_text("an earlier table")
    command = [sys.executable, "-m", "capture_sim.cli", "sweep", "tilt_0", "--workers=3"]
    command += ["--vary=buffer.c_A=uniform(5, 30)", "--runs=100000", f"--out={out}"]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as run:
        while len(child_processes(run.pid)) < children:
            assert run.poll() is None
            time.sleep(0.002)
        started = child_processes(run.pid)
        os.killpg(run.pid, signal.SIGINT)
        _, errors = run.communicate(timeout=600)
    assert run.returncode == 130
    assert len(errors.splitlines()) == 1
    assert errors.startswith("capture-sim: interrupted")
    assert out.read_text() == "an earlier table"
    deadline = time.monotonic() + 600.0
    while any(Path(f"/proc/{pid}").exists() for pid in started):
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_has_its_units_and_is_read_as_cases_again(suffix, tmp_path, capsys):
    out, again = tmp_path / f"a.{suffix}", tmp_path / f"b.{suffix}"
    options = ["--workers=1", "--set", "run.t_end=3", "--check"]
    vary = ["--vary", "buffer.k_A=normal(500, 5%)", "--vary", "initial.target.theta=0,5 deg"]
    assert main(["sweep", "tilt_0", *vary, "--runs=3", *options, f"--out={out}"]) == 0
    text = capsys.readouterr().out
    assert "capture-sim run tilt_0 --set run.t_end=3 --set run.rtol=1e-06 --set buffer.k_A=" in text
    assert main(["sweep", "tilt_0", f"--from={out}", *options, f"--out={again}"]) == 0
    assert read_cases(again).equals(read_cases(out))
    if suffix == "csv":
        head = out.read_text().splitlines()[0].split(",")
        assert head[:3] == ["run", "buffer.k_A [N/m]", "initial.target.theta [rad]"]
        assert "max_torsion [rad]" in head
        assert out.read_bytes() == again.read_bytes()
        made_by = json.loads(out.with_name(f"{out.stem}_made_by.json").read_text())
    else:
        made_by = pd.read_parquet(out).attrs["made_by"]
        assert pd.read_parquet(out).attrs["units"]["buffer.k_A"] == "N/m"
        assert_frame_equal(pd.read_parquet(again), pd.read_parquet(out), check_exact=True)
    assert made_by["scene"] == "tilt_0"
    assert len(made_by["scene_sha256"]) == 64
    assert "run.t_end=3" in made_by["overrides"]
    assert made_by["software"][1].startswith(f"capture_sim {capture_sim.__version__}")


def test_inputs_are_printed_in_the_unit_in_which_they_were_typed(tmp_path, capsys):
    """And the commands, whose values are rounded, repeat the loads that are printed."""
    vary = ["--vary=approach.angle=-7 deg:7 deg:3", "--vary=approach.offset=normal(2 cm, 1 mm)"]
    options = ["--runs=2", "--set=run.t_end=3", "--workers=1", f"--out={tmp_path / 'a.csv'}"]
    assert main(["sweep", "tilt_0", *vary, *options]) == 0
    printed = capsys.readouterr().out
    assert "approach.angle = -7 deg: captured" in printed
    found = re.findall(r"\d: ([\d.]+) N, [\w, ]+: capture-sim run tilt_0 (.*)", printed)
    assert len(found) == 3
    for force, words in found:
        overrides = [word for word in shlex.split(words) if word != "--set"]
        assert sum(word.endswith((" deg", " cm")) for word in overrides) == 2
        again = capture_sim.simulate("tilt_0", overrides).loads["max_normal_force"]
        assert f"{again:.4g}" == force


def test_sensors_change_no_verdict_and_the_command_says_so(tmp_path, capsys):
    noisy = ["--set", "sensors.motion_capture.position_noise=1 mm", "--set", "run.t_end=4"]
    vary = ["--vary=buffer.c_A=5,25", "--workers=1", f"--out={tmp_path / 'a.csv'}"]
    assert main(["sweep", "tilt_0", *noisy, *vary]) == 0
    shown = capsys.readouterr()
    assert "verdicts are of the exact motion" in shown.err
    exact = capture_sim.sweep("tilt_0", {"buffer.c_A": [5, 25]}, {"run.t_end": 4}, executor=HERE)
    found = pd.read_csv(tmp_path / "a.csv")
    assert found["verdict"].tolist() == exact["verdict"].tolist()
    assert found["verdict_time [s]"].tolist() == exact["verdict_time"].tolist()


def test_own_cases_are_run_with_their_units(tmp_path, capsys):
    cases, out = tmp_path / "cases.csv", tmp_path / "out.csv"
    cases.write_text("friction.mu [1],buffer.c_A [N s/m],remark\n0.1,10,a\n0.2,12,b\n-1,12,c\n")
    options = ["--set", "run.t_end=0.5", "--workers=1", f"--out={out}"]
    assert main(["sweep", "tilt_0", f"--from={cases}", *options]) == 0
    assert "could not be computed, e.g. run 2: row 2: friction.mu = -1.0: must be >= 0" in (
        capsys.readouterr().out
    )
    cases.write_text(cases.read_text().replace("-1,", "0.25,"))
    assert main(["sweep", "tilt_0", f"--from={cases}", *options]) == 0
    shown = capsys.readouterr()
    assert shown.err.count("\n") == 1
    assert "remark" in shown.err  # no field of the scene: named once, and kept
    assert "95 % interval" in shown.out
    assert pd.read_csv(out)["friction.mu [1]"].tolist() == [0.1, 0.2, 0.25]
    cases.write_text("initial.target.theta [deg], buffer.k_A\n5, 0.5 N/mm\n-5, 600\n")
    samples = samples_of(load_scene("tilt_0"), read_cases(cases))
    assert samples.rows == [(math.radians(5.0), 500.0), (math.radians(-5.0), 600.0)]


def test_the_command_says_why_runs_could_not_be_computed(tmp_path, capsys):
    """Each kind of reason once, the most frequent first; a grid has no percentiles."""
    vary = ["--vary=initial.target.x=-1e3,0.45,0.44,0.9", "--set", "run.t_end=0.5", "--workers=1"]
    assert main(["sweep", "tilt_0", *vary, f"--out={tmp_path / 'a.csv'}"]) == 0
    shown = capsys.readouterr().out
    reasons = re.findall(r"(\d) could not be computed, e.g. run (\d)", shown)
    assert reasons == [("2", "1"), ("1", "0")]
    assert "95%" not in shown


def test_a_sweep_that_only_misses_prints_the_closest_approaches(tmp_path, capsys):
    """A grid prints effects; one run has neither interval nor probability."""
    vary = ["--vary=approach.offset=0.3,0.31,0.32,0.33", "--set", "run.t_end=3", "--workers=1"]
    assert main(["sweep", "tilt_0", *vary, "--check", f"--out={tmp_path / 'a.csv'}"]) == 0
    printed = capsys.readouterr().out
    lines = [line for line in printed.splitlines() if "capture-sim run" in line]
    table = pd.read_csv(tmp_path / "a.csv")
    assert [line.split(": ", 2)[2] for line in lines] == table["command"].tolist()[:3]
    effect = np.ptp(table["nearest_distance [m]"]) * 1e3
    row = next(line for line in printed.splitlines() if line.startswith("approach.offset  "))
    assert float(row.split()[-2]) == pytest.approx(effect, rel=1e-3)
    vary[:1] = ["--vary=buffer.k_A=normal(500, 5%)", "--runs=1"]
    assert main(["sweep", "tilt_0", *vary, f"--out={tmp_path / 'a.csv'}"]) == 0
    printed = capsys.readouterr().out
    assert "interval" not in printed
    assert ".." not in printed


def test_a_stroke_of_round_off_is_zero():
    extremes = np.zeros(1, EXTREMES)[0]
    extremes["axial_stroke_out"], extremes["axial_stroke_in"] = 5.551e-17, 5.551e-7
    loads = loads_of(Extremes(extremes, None), np.zeros(0, TOUCH))
    assert (loads["max_axial_stroke_out"], loads["max_axial_stroke_out_time"]) == (0.0, None)
    assert loads["max_axial_stroke_in"] == 5.551e-7


def test_an_offset_at_the_mouth_aims_at_its_centre():
    """The straight path of the tip passes the mouth's centre at this distance, to the left."""
    for angle in (-0.3, 0.0, 0.3):
        changes = {"approach.angle": angle, "approach.mouth_offset": 0.012, "approach.speed": 0.1}
        scene = load_scene("tilt_p10", changes)
        chaser, target, cone = scene.initial.chaser, scene.initial.target, scene.cone
        along = np.array([math.cos(chaser.theta), math.sin(chaser.theta)])
        axis = np.array([math.cos(target.theta), math.sin(target.theta)])
        mouth = np.array([target.x, target.y]) - axis * (
            cone.L_T + cone.L_c * math.cos(cone.half_angle)
        )
        off = np.array([chaser.x, chaser.y]) - mouth
        assert along[0] * off[1] - along[1] * off[0] == pytest.approx(0.012, abs=1e-12)
        assert scene.rail is None


def test_the_approach_of_a_run_is_set_as_in_a_sweep(tmp_path, capsys):
    changes = ["--set=approach.angle=5 deg", "--set=approach.offset=3 mm"]
    options = ["--no-record", f"--out={tmp_path}"]
    assert main(["run", "tilt_0", *changes, "--set=run.t_end=3", *options]) == 0
    found = json.loads((tmp_path / "results.json").read_text())[0]
    vary = {"approach.angle": ["5 deg"], "approach.offset": ["3 mm"]}
    table = capture_sim.sweep("tilt_0", vary, SHORT, rtol=1e-8, executor=HERE)
    assert found["max_normal_force"] == table["max_normal_force"][0] > 0.0
    capsys.readouterr()
    assert main(["run", "tilt_0", "--set=approach.angel=1", *options]) == 2
    assert "approach.angel: unknown field" in capsys.readouterr().err


PICTURES = {
    "curve": ({"buffer.c_A": [5, 20]}, {"curve"}),
    "curve of draws": (
        {"buffer.c_A": [5, 20], "buffer.k_A": "normal(500, 5%)"},
        {"curve", "loads", "tornado"},
    ),
    "map": ({"approach.angle": [-0.1, 0.1], "approach.speed": [0.1, 0.2]}, {"map"}),
    "map of three": (
        {
            "approach.angle": [-0.1, 0.1],
            "approach.offset": [0.0, 0.01],
            "approach.speed": [0.1, 0.2],
        },
        {"map"},
    ),
    "draws": ({"buffer.c_A": "uniform(5, 20)"}, {"loads", "tornado"}),
    "table": (
        pd.DataFrame({"buffer.c_A": [5.0, 6.0, 7.0], "buffer.k_A": [400.0, 500.0, 600.0]}),
        {"loads", "tornado"},
    ),
}


@pytest.mark.parametrize("vary, names", PICTURES.values(), ids=PICTURES)
def test_pictures_fit_what_was_varied(vary, names, tmp_path):
    scene = load_scene("tilt_0", ["run.t_end=3", "run.rtol=1e-6"])
    drawn = not isinstance(vary, pd.DataFrame) and any("(" in str(v) for v in vary.values())
    samples = samples_of(scene, vary, 4 if drawn else 0)
    table = module.run_samples(scene, samples, executor=HERE)
    table = table.assign(exceeded=["max_torsion", *[""] * (len(table) - 1)])
    limits = make_limits({"max_torsion": 1e-3, "max_normal_force": 100.0})
    figures = draw_sweep(table, samples.axes, scene.name, limits=limits)
    assert set(figures) == names
    if "loads" in figures:
        title = figures["loads"].get_suptitle()
        assert "95 % interval" in title
    for name, figure in figures.items():
        figure.savefig(tmp_path / f"{name}.png")


def test_a_table_is_drawn_as_what_it_is():
    curve = capture_sim.sweep("tilt_0", {"buffer.c_A": [5, 20]}, {"run.t_end": 3}, executor=HERE)
    assert len(capture_sim.plot(curve).axes) == 4
    vary = {"buffer.c_A": "uniform(5, 20)"}
    drawn = capture_sim.sweep("tilt_0", vary, {"run.t_end": 3}, runs=4, executor=HERE)
    assert "95 % interval" in capture_sim.plot(drawn).get_suptitle()
    assert "tilt_0" in capture_sim.load_scene("tilt_0", {"run.t_end": 3}).plot().get_suptitle()
    with pytest.raises(TypeError, match="must be runs"):
        capture_sim.plot(pd.DataFrame())


def test_saltellis_runs_are_drawn_as_their_indices(tmp_path, capsys):
    vary = ["--vary=buffer.c_A=uniform(5, 20)", "--vary=friction.mu=uniform(0, 0.3)"]
    design = ["--sample=saltelli", "--runs=4", "--set", "run.t_end=3.2", "--workers=1"]
    assert main(["sweep", "tilt_0", *vary, *design, f"--out={tmp_path / 'a.csv'}"]) == 0
    assert "Sobol indices of max_normal_force, 4 base samples" in capsys.readouterr().out
    assert {path.name for path in tmp_path.glob("*.png")} == {"a_loads.png", "a_indices.png"}


@pytest.mark.parametrize(
    "text, message",
    [
        ("buffer.c_A,buffer.c_A\n5,6\n", "column buffer.c_A: must be given once"),
        ("buffer.c_A,buffer.c_A [N s/m]\n5,6\n", "column buffer.c_A: must be given once"),
        ("buffer.c_A;buffer.k_A\n5;6\n", "columns must be separated by commas"),
        ("", "is not a table"),
        ("buffer.c_A\n5,6\n", "is not a table"),
    ],
)
def test_a_table_that_is_no_cases_is_rejected(text, message, tmp_path):
    path = tmp_path / "cases.csv"
    path.write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_cases(path)


@pytest.mark.parametrize(
    "rows, drawn",
    [
        ([(k, mu, "coulomb") for k in (300, 500) for mu in (0.1, 0.2)], {"map"}),
        ([(k, mu, "coulomb") for k in (300, 500) for mu in (0.1, 0.2)] * 2, {"loads", "tornado"}),
        (
            [(k, mu, law) for k in (300, 500) for mu in (0.1, 0.2) for law in ("coulomb", "tanh")],
            {"loads", "tornado"},
        ),
    ],
    ids=["each once", "rows repeat", "a text varies too"],
)
def test_a_combination_with_several_runs_has_no_map(rows, drawn):
    """A map has one colour for each combination of two numbers."""
    cases = pd.DataFrame(rows, columns=["buffer.k_A", "friction.mu", "friction.law"])
    scene = load_scene("tilt_0", SHORT)
    samples = samples_of(scene, cases)
    table = capture_sim.sweep(scene, cases, executor=HERE)
    assert set(draw_sweep(table, samples.axes, "tilt_0", ())) == drawn


def test_a_cell_without_a_value_in_parquet_is_a_blank(tmp_path):
    """As in a CSV file: its row has no value there, and says so."""
    path = tmp_path / "cases.parquet"
    table = pd.DataFrame({"friction.law": ["coulomb", None], "buffer.c_A [N s/m]": ["5", None]})
    table.to_parquet(path)
    cases = read_cases(path)
    assert cases["friction.law"].tolist() == ["coulomb", ""]
    assert cases["buffer.c_A"].tolist() == ["5 N s/m", ""]
    table = capture_sim.sweep("tilt_0", cases, executor=HERE)
    assert table["failure"].tolist() == ["", "row 1: friction.law: has no value"]


def test_a_run_that_would_fill_the_memory_is_a_row_with_its_reason():
    table = capture_sim.sweep("tilt_0", {"run.t_end": [1e6, 0.5]}, executor=HERE)
    assert table["verdict"].tolist() == ["failed", "undecided"]
    assert "run.t_end = 1e+06 s at run.rate = 100 Hz" in table["failure"][0]


def test_a_stroke_without_room_names_what_to_set(tmp_path, capsys):
    """At 1 m/s without stops, the probe goes 132 mm into a cylinder of 136.5 mm."""
    fast = ["tilt_0", "--set=string.impact_speed=1", "--set=run.t_end=3"]
    assert main(["run", *fast, "--no-record", f"--out={tmp_path}"]) == 0
    assert ": stroke inwards 131.7 mm" in (warning := capsys.readouterr().err)
    assert "set stops.compression" in warning
    vary = ["--vary=buffer.c_A=13,14", "--workers=1", f"--out={tmp_path / 'a.csv'}"]
    assert main(["sweep", *fast, *vary]) == 0
    assert "2 runs have too long a stroke" in capsys.readouterr().err
    slow = ["tilt_0", "--set=run.t_end=3"]
    assert main(["sweep", *slow, *vary]) == 0
    assert capsys.readouterr().err == ""


def test_one_bad_row_of_a_table_is_a_failed_run_with_its_reason_and_notes_stay():
    cases = pd.DataFrame({"buffer.c_A": [5.0, -1.0, None, "4 kg"], "note": ["a", "b", "c", "d"]})
    with pytest.warns(UserWarning, match="kept as notes: note"):
        table = capture_sim.sweep("tilt_0", cases, executor=HERE)
    assert table["verdict"].tolist() == ["captured", *["failed"] * 3]
    assert table["note"].tolist() == ["a", "b", "c", "d"]
    reasons = table["failure"].tolist()
    assert reasons[1].startswith("row 1: buffer.c_A = -1.0 N s/m: must be >= 0")
    assert reasons[2] == "row 2: buffer.c_A: has no value"
    assert reasons[3].startswith("row 3: buffer.c_A = '4 kg'")


@pytest.mark.parametrize("kept", [0, 1, 4])
def test_a_killed_sweep_continues_to_the_same_table(kept, tmp_path, capsys):
    """Killed after some pieces: the journal ends there, the last one torn."""
    arguments = ["sweep", "tilt_0", "--vary=buffer.c_A=uniform(5,30)", "--runs=90", "--workers=1"]
    arguments += ["--set=run.t_end=1", f"--out={tmp_path / 'a.csv'}"]
    journal = tmp_path / "a.csv.journal"
    kept_journal = []
    real = Journal.remove

    def keep(self):
        kept_journal.append(self.path.read_bytes())
        real(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Journal, "remove", keep)
        assert main(arguments) == 0
    assert not journal.exists()
    undisturbed = (tmp_path / "a.csv").read_bytes()
    lines = kept_journal[0].splitlines(keepends=True)
    assert len(lines) > 5
    journal.write_bytes(b"".join(lines[: 1 + kept]) + lines[1 + kept][:30])
    (tmp_path / "a.csv").unlink()
    capsys.readouterr()
    assert main([*arguments, "--resume"]) == 0
    done = sum(len(rows) for _, rows in map(json.loads, lines[1 : 1 + kept]))
    assert f"{done} of 90 runs were done before" in capsys.readouterr().out
    assert (tmp_path / "a.csv").read_bytes() == undisturbed
    assert main([*arguments, "--resume"]) == 0  # a job that is queued once more
    assert capsys.readouterr().out == f"complete: 90 runs, table in {tmp_path / 'a.csv'}\n"
    (tmp_path / "a.csv").unlink()
    assert main([*arguments, "--resume"]) == 0  # before its first run it begins
    assert "0 of 90 runs were done before" in capsys.readouterr().out
    assert (tmp_path / "a.csv").read_bytes() == undisturbed
    journal.write_bytes(b"".join(lines))
    assert main([*arguments, "--seed=2", "--resume"]) == 2
    assert "is of another study: vary must be the same" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_a_table_of_the_first_runs_is_not_complete(suffix, tmp_path):
    """Ctrl-C has ended the sweep, and its journal has not been copied with it."""
    table = capture_sim.sweep("tilt_0", {"buffer.c_A": [5, 6, 7]}, ["run.t_end=0.2"], executor=HERE)
    about = {"scene": load_scene("tilt_0").to_yaml(), "runs": 3, "seed": 1}
    path = tmp_path / f"a.{suffix}"
    for count in (2, 3):
        part = table[:count]
        part.attrs = table.attrs
        write_sweep(part, path, about)
        assert is_complete(path, about) is (count == 3)
    assert not is_complete(path, about | {"seed": 2})


def test_a_kill_before_the_description_leaves_none_of_another_table(tmp_path, monkeypatch):
    """Else `--resume` of the earlier sweep would take the new table for its own."""
    table = capture_sim.sweep("tilt_0", {"buffer.c_A": [5, 6]}, ["run.t_end=0.2"], executor=HERE)
    about = {"scene": load_scene("tilt_0").to_yaml(), "runs": 2, "seed": 1}
    path, written = tmp_path / "a.csv", []

    def killed_at_the_second(file):
        written.append(file)
        if len(written) == 2:
            raise KeyboardInterrupt
        return whole_file(file)

    write_sweep(table, path, about)
    monkeypatch.setattr("capture_sim.recording.sweep_file.whole_file", killed_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        write_sweep(table, path, about | {"seed": 2})
    assert written[0] == path
    assert not is_complete(path, about)


def test_a_sweep_without_one_good_run_fails(tmp_path):
    arguments = ["sweep", "tilt_0", "--vary=initial.target.x=-1e3,-1e4"]
    assert main([*arguments, "--workers=1", f"--out={tmp_path / 'a.csv'}"]) == 1


def test_indices_leave_out_base_samples_with_a_failed_run():
    """Three inputs by a known function; the failed runs have loads up to their failure."""
    inputs = ["buffer.c_A", "buffer.k_A", "buffer.k_T"]
    vary = dict.fromkeys(inputs, "uniform(1, 2)")
    samples = samples_of(load_scene("tilt_0"), vary, 64, "saltelli")
    x = np.array(samples.rows)
    table = pd.DataFrame({"verdict": "captured", "max_torsion": x @ [1.0, 2.0, 3.0]})
    whole = sobol_indices(table, inputs, "max_torsion")
    spoilt = table.copy()
    spoilt.loc[7, ["verdict", "max_torsion"]] = "failed", 1e3
    found = sobol_indices(spoilt, inputs, "max_torsion")
    assert (whole.used, found.used) == (64, 63)
    assert len(complete_samples(spoilt, inputs)) == 63 * 5
    assert found.total == pytest.approx(whole.total, abs=0.1)


def test_short_names_are_those_of_every_command():
    """Before, only the fits knew them."""
    by_path = {"supports.chaser.c_rr": 2e-3, "supports.target.c_rr": 2e-3, "buffer.c_A": 9.0}
    expected = capture_sim.load_scene("tilt_0", by_path)
    named = capture_sim.load_scene("tilt_0", ["c_rr=2e-3", "c_A=9"])
    assert (named.supports, named.buffer) == (expected.supports, expected.buffer)
    table = capture_sim.sweep("paper_designed", {"e": [0.3, 0.6], "mu": [0.2]})
    paths = {"contact.restitution": [0.3, 0.6], "friction.mu": [0.2]}
    other = capture_sim.sweep("paper_designed", paths)
    assert table["max_normal_force"].tolist() == other["max_normal_force"].tolist()
    with pytest.raises(SceneError, match=r"contact\.restitution: varies twice"):
        capture_sim.sweep("paper_designed", {"e": [0.3], "contact.restitution": [0.3]})
