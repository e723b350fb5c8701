"""What simulate() takes and hands out, as one meets it in a notebook."""

import importlib
import json
import multiprocessing
import pydoc
import sys
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

import capture_sim
from capture_sim import MissingPackageError, SceneError, SimulationError, load_scene, simulate
from capture_sim.messages.units import unit_of
from capture_sim.run.loads import (
    LOADS,
    extremes_from_text,
    extremes_to_text,
    loads_of,
    sampled_extremes,
)
from capture_sim.studies.evaluate.executors import InProcess
from capture_sim.studies.evaluate.outcome import run_to_end


@pytest.fixture(scope="module")
def run():
    return simulate("paper_designed", {"buffer.c_A": 20}, t_end=0.5)


def test_a_name_and_overrides_are_the_loaded_scene(run):
    listed = simulate(load_scene("paper_designed"), ["buffer.c_A=20"], t_end=0.5)
    assert run.scene.buffer.c_A == 20.0
    assert run.scene.title == load_scene("paper_designed", {"buffer.c_A": 20}).title
    assert listed.samples.tobytes() == run.samples.tobytes()
    changes = {"latch": None, "friction.law": "coulomb", "contact.tip": {"E": np.float64(7e10)}}
    changed = load_scene("tilt_0", changes)
    assert changed.latch is None
    assert changed.friction.law == "coulomb"
    assert (changed.contact.tip.E, changed.contact.tip.nu) == (7e10, 0.3)


def test_a_result_is_shown_in_a_line_and_in_a_table(run):
    assert repr(run) == (
        "Run(paper_designed: undecided, 6 touches, peak 131.6 N, 501 samples to 0.5 s)"
    )
    page = run._repr_html_()
    assert page.startswith("<table>")
    assert len(page) < 3000
    assert f"{run.summary['impact_speed']:.4f}" in page
    assert f"<th>buffer.c_A</th><td>{run.scene.buffer.c_A}</td>" in run.scene._repr_html_()
    touch = next(event for event in run.events if event.kind.label == "touch")
    assert repr(touch).startswith(f"Event(touch at {touch.t:.6g} s, wall ")


def test_text_of_a_scene_is_escaped_in_the_table():
    title = {"title": "<script>alert(1)</script>"}
    assert "<script>" not in simulate("paper_designed", title, t_end=0.01)._repr_html_()


def test_a_dataframe_has_a_named_column_for_every_number(run):
    frame = run.to_dataframe()
    numbers = sum(int(np.prod(run.samples.dtype[name].shape)) for name in run.samples.dtype.names)
    assert frame.shape == (501, numbers - 1)
    assert np.array_equal(frame.index, run.t)
    assert frame.index.name == "t"
    assert np.array_equal(frame["q.theta_P"], run.q[:, 3])
    assert np.array_equal(frame["penetration.-y"], run.samples["penetration"][:, 1])
    assert np.array_equal(frame["contact_force.y"], run.samples["contact_force"][:, 1])


def test_touches_and_events_are_tables(run):
    touches, events = run.to_dataframe("touches"), run.to_dataframe("events")
    assert list(touches.columns) == list(run.touches.dtype.names)
    assert np.array_equal(touches["peak_force"], run.touches["peak_force"])
    assert events.index.tolist() == [event.t for event in run.events]
    lifted = events[events["kind"] == "lift_off"]
    assert lifted.index.tolist() == run.touches["end"].tolist()[: len(lifted)]
    assert np.array_equal(events["v.theta_P"], [event.v[3] for event in run.events])


@pytest.mark.parametrize(
    "table, message",
    [("samples", "BenchState"), ("touches", "BenchEvent"), ("events", "BenchEvent")],
)
def test_the_units_of_a_dataframe_are_those_of_the_messages(run, table, message):
    frame = run.to_dataframe(table)
    units = frame.attrs["units"]
    indexed = {"t"} if table != "touches" else set()
    assert units.keys() == {*frame.columns} | indexed
    for name, unit in units.items():
        recorded = {"start": "touch_start", "end": "touch_start"}.get(name, name)
        assert unit == unit_of(f"capture_sim/msg/{message}", recorded), name


@pytest.mark.parametrize("table", ["touch", "loads", "", None])
def test_an_unknown_table_is_rejected(run, table):
    with pytest.raises(ValueError, match="must be one of samples, touches, events"):
        run.to_dataframe(table)


@pytest.mark.parametrize("given", [["tilt_0"], [[]]])
def test_what_is_no_run_is_not_drawn(run, given):
    with pytest.raises(TypeError, match="must be runs, one argument each"):
        capture_sim.plot(run, *given)


def test_several_runs_are_drawn_over_each_other(run):
    other = simulate("paper_designed", {"buffer.c_A": 5}, t_end=0.5)
    figure = capture_sim.plot(run, other, labels=["20", "5"])
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"20", "5"} <= set(texts)
    colours = {line.get_color() for line in figure.axes[1].get_lines()}
    assert len(colours) >= 2


def test_the_verdict_is_one_text_everywhere():
    scene = load_scene("paper_designed")
    result = simulate(scene)
    table = capture_sim.sweep(scene, {"buffer.c_A": [scene.buffer.c_A]}, executor=InProcess())
    verdicts = [result.verdict, result.summary["verdict"], run_to_end(scene).verdict]
    verdicts += [*table["verdict"], json.loads(json.dumps(result.summary))["verdict"]]
    assert verdicts == ["captured"] * 5
    assert {type(verdict) for verdict in verdicts} == {str}


def test_a_verdict_not_asked_for_costs_nothing(monkeypatch):
    """Samples of one's own are computed alone; the detector's are when the verdict is wanted."""
    counts = []
    finish = capture_sim.Bench.finish

    def counted(bench, times):
        samples = finish(bench, times)
        counts.append(len(samples))
        return samples

    monkeypatch.setattr(capture_sim.Bench, "finish", counted)
    own = simulate("tilt_0", t_eval=[0.0, 2.8, 3.0])
    assert sum(counts) == 3
    assert own.loads["touches"] == len(own.touches)
    assert sum(counts) == 3
    whole = simulate("tilt_0")
    assert sum(counts) == 3 + len(whole.statuses) - 1  # those of the detector alone
    assert whole.samples.size == sum(counts) - 3 - len(whole.statuses) + 1
    assert own.verdict == whole.verdict
    assert own.loads == whole.loads
    assert own.statuses == whole.statuses


@pytest.mark.parametrize("package, method", [("pandas", "to_dataframe"), ("matplotlib", "plot")])
def test_a_missing_package_is_named_in_one_line(run, monkeypatch, package, method):
    for name in [n for n in sys.modules if n.startswith((package, "capture_sim.viewing"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingPackageError, match=rf"{package}: pip install "):
        getattr(run, method)()


def test_enumerations_print_their_name(run):
    assert [str(event.kind) for event in run.events[:2]] == ["release", "touch"]
    assert f"{capture_sim.Phase.FREE}" == "free"


def test_public_names_are_all_there():
    public = {name for name in dir(capture_sim) if not name.startswith("_")}
    assert {"Run", "Scene", "load_scene", "plot", "read_run", "simulate", "sweep"} <= public
    for name in public:
        assert getattr(capture_sim, name) is not None
    page = pydoc.render_doc(capture_sim)
    assert len(page.splitlines()) < 100
    assert all(name in page for name in public)
    with pytest.raises(AttributeError):
        importlib.import_module("capture_sim").nothing  # noqa: B018


def test_a_run_that_would_fill_the_memory_is_refused_before_it_starts():
    with pytest.raises(
        SceneError, match=r"run.t_end = 20000 s at .* GB of memory: must be at most 4 GB"
    ):
        simulate("tilt_0", {"run.t_end": 20000})


def test_a_finished_run_is_kept_where_the_finer_one_fails():
    """The steps that suffice for the run do not for the finer one."""
    cost = simulate("paper_designed").statistics
    steps = cost.steps + cost.rejected
    with pytest.raises(SimulationError) as failed:
        simulate("paper_designed", {"run.max_steps": steps, "run.rtol": 1e-10})
    run = simulate("paper_designed", {"run.max_steps": steps}, check=True)
    assert "max_steps" in run.check.failure
    assert run.verdict == "captured"
    known = np.isfinite(run.check.error)
    assert run.t[known][-1] == failed.value.result.t[-1]
    assert run.check.error[100] < 1e-8
    assert np.all(run.check.error[~known] == np.inf)


def test_a_run_that_fails_in_a_worker_says_so_where_it_was_asked_for():
    """An error that cannot be sent breaks the pool, and nobody learns why."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        failed = pool.submit(simulate, "paper_designed", {"run.max_steps": 100}).exception()
    assert isinstance(failed, SimulationError)
    assert "run.max_steps" in str(failed)
    assert len(failed.partial) == len(failed.result.t) > 0


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "tilt_m10"])
def test_loads_are_of_the_whole_run_and_until_the_latch(name):
    run = simulate(name)
    latch = next(event.t for event in run.events if event.kind.label == "latched")
    for load in LOADS:
        whole, time = run.loads[load.key], run.loads[f"{load.key}_time"]
        assert (time is None) == (whole == 0.0)
        if load.key == "max_latch_force":
            assert time >= latch
            continue
        before = run.loads[f"{load.key}_before_latch"]
        assert whole <= before if load.least else whole >= before
        # the whole run's is the earlier one unless it came after the latch
        assert (whole == before) == (time is None or time <= latch)
    stroke, torsion = run.samples["axial_stroke"], np.abs(run.samples["torsion"])
    assert run.loads["max_axial_stroke_in"] == pytest.approx(-stroke.min(), rel=1e-3)
    assert run.loads["max_axial_stroke_out"] == pytest.approx(stroke.max(), rel=1e-3)
    assert run.loads["max_torsion"] == pytest.approx(torsion.max(), rel=1e-3)
    assert run.loads["max_normal_force"] == run.touches["peak_force"].max()
    assert run.loads["touches"] == len(run.touches)


@pytest.mark.parametrize("damping", [0.0, 30.0, 2000.0])
@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "tilt_m10"])
def test_the_force_of_a_closing_latch_is_known_without_the_integrator(name, damping):
    run = simulate(name, {"latch.damping": damping})
    extremes = sampled_extremes(run.scene, run.samples, run.touches, run.events)
    force = loads_of(extremes, run.touches)["max_latch_force"]
    assert force == pytest.approx(run.loads["max_latch_force"], rel=0.01)


@pytest.mark.parametrize("name", ["tilt_0", "tilt_p10", "tilt_m10"])
def test_loads_of_samples_cost_what_the_docs_say(name):
    run = simulate(name)
    extremes = sampled_extremes(run.scene, run.samples, run.touches, run.events)
    sampled = loads_of(extremes, run.touches)
    for load in LOADS:
        lost = abs(run.loads[load.key] - sampled[load.key])
        if load.unit in ("m", "rad") and load.key != "max_penetration":
            assert lost < 1e-6, load.key
        elif load.key.startswith("max_normal_force"):
            assert lost == 0.0
        else:
            share = {"max_penetration": 0.6}.get(load.key, 1e-3)
            assert lost <= share * run.loads[load.key], load.key


def test_extremes_are_read_back_from_text():
    run = simulate("tilt_p10")
    read = extremes_from_text(extremes_to_text(run.extremes))
    assert read.before_latch.tobytes() == run.extremes.before_latch.tobytes()
    assert read.after_latch.tobytes() == run.extremes.after_latch.tobytes()


@pytest.mark.parametrize(
    "text", ["", "{}", "[1]", "null", '{"before_latch": [1], "after_latch": null}']
)
def test_other_text_is_no_extremes(text):
    with pytest.raises(ValueError):  # noqa: PT011
        extremes_from_text(text)
