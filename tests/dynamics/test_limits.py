"""Where a run has to stop, and where it must not; and kernels without Numba."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace

import numpy as np
import pytest
from random_scenes import random_scenes, wide_scenes

from capture_sim import Bench, SimulationError, load_scene
from capture_sim.base.compiled.kernels import cache_folder
from capture_sim.errors import CaptureSimError
from capture_sim.scene.parts import Stops

STOPS = "stops={compression: 0.1995, extension: 0.19, stiffness: 1.0e+6, damping: 10}"


@pytest.mark.parametrize("method", ["dop853", "dopri5"])
def test_probe_that_slides_freely_to_its_stop_is_not_taken_for_one_in_its_hinge(method):
    """No spring, no damper: a step may end far behind the stop that cuts it."""
    scene = load_scene(
        "paper_designed",
        [
            *("buffer.k_A=0", "buffer.c_A=0", "contact.restitution=1", STOPS),
            *("run.t_end=4", f"run.method={method}"),
        ],
    )
    bench = Bench(scene)
    samples = bench.advance(bench.times(0, 5000))
    kinds = [event.kind.label for event in bench.events]
    assert "stop_hit" in kinds
    assert -0.2 < samples["axial_stroke"].min() < -0.1995
    assert np.abs(samples["energy_residual"]).max() < 1e-6 * samples["kinetic"].max()


@pytest.mark.parametrize(
    "override, part",
    [
        ("buffer.k_A=1e30", "axial spring .probe.density, buffer.k_A."),
        ("probe.density=1e-12", "axial damper .probe.density, buffer.c_A."),
        (
            "friction.slip_regularization_speed=1e-15",
            "friction of the tip .friction.slip_regularization_speed.",
        ),
    ],
)
def test_hopeless_run_ends_after_so_many_steps_and_names_what_makes_it_so(override, part):
    """Rejected steps are work, too: the stiffest spring there is has more of them than others."""
    bench = Bench(load_scene("paper_designed", [override, "run.max_steps=20000"]))
    with pytest.raises(SimulationError, match=f"stiffest is the {part}"):
        bench.advance([])
    cost = bench.statistics
    tried = cost.steps + cost.rejected
    assert tried <= 20_000 + 60  # to halve a step until it falls below 1e-15 s
    assert cost.evaluations <= 16 * tried


def test_ctrl_c_ends_a_slow_run():
    """A run of minutes in one call; it ends long before its steps are used up."""
    code = (
        "from capture_sim import Bench, load_scene\n"
        "from capture_sim.dynamics.compilation import compile_kernels\n"
        "compile_kernels()\n"
        "b = Bench(load_scene('paper_designed', ['probe.density=1e-9']))\n"
        "print('ready', flush=True)\n"
        "try:\n"
        "    b.advance([])\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted', b.statistics.steps < 9_000_000)\n"
    )
    run = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert run.stdout.readline() == "ready\n"
    time.sleep(0.3)
    run.send_signal(signal.SIGINT)
    out, _ = run.communicate(timeout=600)
    assert out == "interrupted True\n"


def test_everything_runs_without_numba():
    code = (
        "import numpy as np\n"
        "from capture_sim import Bench, load_scene\n"
        "b = Bench(load_scene('paper_designed', ['run.rtol=1e-6']))\n"
        "s = b.advance(np.array([0.0, 2e-3]))\n"
        "print(*s['q'][-1].tolist(), len(b.events))\n"
    )
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    slow = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    bench = Bench(load_scene("paper_designed", ["run.rtol=1e-6"]))
    q = bench.advance(np.array([0.0, 2e-3]))["q"][-1]
    *found, events = map(float, slow.stdout.split())
    assert found == pytest.approx(q.tolist(), abs=1e-12)
    assert events == len(bench.events)


@pytest.fixture
def blocked_cache(tmp_path, monkeypatch):
    """The kernels' folder cannot be written to; the one for temporary files is this test's."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("CAPTURE_SIM_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / f"capture_sim-{os.getuid()}"


def test_unwritable_cache_falls_back_in_a_line(blocked_cache, capsys):
    assert cache_folder.__wrapped__().parent == blocked_cache
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "cannot be written to" in said


@pytest.mark.parametrize("kind", ["of another user", "open to others", "a link", "a file"])
def test_cache_in_the_temporary_folder_must_belong_to_the_user(kind, blocked_cache):
    """Compiled kernels are pickles: who writes them may run any code."""
    if kind == "a link":
        elsewhere = blocked_cache.with_name("elsewhere")
        elsewhere.mkdir()
        blocked_cache.symlink_to(elsewhere)
    elif kind == "a file":
        blocked_cache.write_text("")
    else:
        blocked_cache.mkdir(mode=0o700)
    if kind == "open to others":
        blocked_cache.chmod(0o777)
    if kind == "of another user":
        if os.getuid() != 0:
            pytest.skip("only root can give a folder away")
        os.chown(blocked_cache, 12345, 12345)
    with pytest.raises(CaptureSimError, match=f"{blocked_cache}: must be a folder of this user"):
        cache_folder.__wrapped__()


def test_spin_counts_in_the_error_scale():
    """Nothing moves but the target, which turns: the cost of a run of its own speed."""
    steps = []
    for rtol in (1e-10, 1e-12):
        over = ["initial.chaser.vx=0", "initial.target.omega=1", "run.t_end=1"]
        bench = Bench(load_scene("paper_designed", [*over, f"run.rtol={rtol}"]))
        bench.advance(np.zeros(0))
        steps.append(bench.statistics.steps)
    assert steps[1] < 3 * steps[0]


@pytest.mark.parametrize("speed, t_end", [(1e-5, 200), (1e-7, 4_000)])
def test_ledger_closes_at_the_slowest_approach(speed, t_end):
    """Without a floor of 1 mm/s in the scale, the ripple of a slow touch is an error."""
    over = [f"initial.chaser.vx={speed}", f"run.t_end={t_end}", "run.state_rate=1", "run.rate=1"]
    bench = Bench(load_scene("paper_designed", over))
    samples = bench.advance(bench.times(0, t_end + 1))
    assert len(bench.touches) > 0
    # 9e-9 and 1.5e-6 of the energy; with the floor 9.5 % at 1e-7 m/s
    assert np.abs(samples["energy_residual"]).max() < 1e-5 * samples["kinetic"].max()


def test_a_tip_that_is_latched_while_it_sticks_is_not_solved_for_sticking_any_more():
    """The walls let go of it, and with them friction; each step costs its own evaluations."""
    bench = Bench(
        load_scene(
            "paper_designed",
            [
                *("friction.law=coulomb", "friction.mu=1.5", "initial.target.y=0.03"),
                "latch={radius: 0.0470193, stiffness: 2.0e+4, damping: 80}",
                "run.after_latch=0.01",
            ],
        )
    )
    bench.advance(np.array([0.064]))
    assert [event.kind.label for event in bench.events[-3:]] == ["stick", "lift_off", "latched"]
    before = bench.statistics
    bench.advance([])
    steps, rejected, evaluations = np.subtract(bench.statistics, before)
    assert evaluations <= 16 * (steps + rejected)


def test_a_run_that_had_to_stop_says_so_again_whenever_it_is_asked():
    bench = Bench(load_scene("paper_designed", ["run.max_steps=100"]))
    with pytest.raises(SimulationError) as first:
        bench.advance(np.linspace(0.0, 1.0, 1001))
    assert first.value.partial.size > 0
    state = bench.statistics, bench.event_count
    for times in (np.array([2.0]), []):
        with pytest.raises(SimulationError) as again:
            bench.advance(times)
        assert str(again.value) == str(first.value)
        assert again.value.partial.size == 0
    assert (bench.statistics, bench.event_count) == state


def test_steps_used_up_without_any_spring_are_an_error_that_keeps_the_samples():
    changes = ["buffer.k_A=0", "buffer.c_A=0", "buffer.k_T=0", "friction.law=none"]
    turning = ["initial.chaser.omega=30", "initial.target.x=5", "run.rtol=1e-13"]
    bench = Bench(load_scene("paper_designed", [*changes, *turning, "run.max_steps=100"]))
    with pytest.raises(SimulationError, match=r"are used up$") as stopped:
        bench.advance(np.linspace(0.0, 1.0, 100_001))
    assert stopped.value.partial.size > 0


@pytest.mark.parametrize("rtol", [3e-3, 1e-3, 1e-8])
@pytest.mark.parametrize("share", [0.9999, 0.999, 0.99])
def test_a_stop_just_short_of_the_largest_stroke_is_met(rtol, share):
    scene = random_scenes(30, seed=4)[2]
    scene = replace(
        scene,
        buffer=replace(scene.buffer, c_A=0.3),
        run=replace(scene.run, t_end=0.3, rtol=rtol),
    )
    bench = Bench(scene)
    bench.advance([])
    stop = share * float(bench.extremes.before_latch["axial_stroke_in"])
    stops = Stops(compression=stop, extension=0.15, stiffness=1e5, damping=0.0)
    stopped = Bench(replace(scene, stops=stops))
    stopped.advance([])
    is_beyond = bool(stopped.extremes.before_latch["axial_stroke_in"] > stop * (1.0 + 1e-9))
    assert is_beyond == any(event.kind.label == "stop_hit" for event in stopped.events)


def loads(bench):
    """Largest stroke inwards, torsion, force of the buffer and normal force of a run."""
    found = bench.extremes.before_latch
    walls = (found["normal_force_plus_y"], found["normal_force_minus_y"])
    names = ("axial_stroke_in", "torsion", "buffer_force")
    return [*(float(found[name]) for name in names), float(max(walls))]


def test_fixed_steps_are_right_to_a_tenth_or_refused():
    """Contacts with strong damping: 25 of 120 such runs were wrong in silence."""
    rng = np.random.default_rng(7)
    accepted = 0
    for scene in random_scenes(60, seed=52):
        law = str(rng.choice(["exact", "gonthier", "flores", "hu_guo"]))
        restitution, step = 10.0 ** rng.uniform(-2.5, -0.5), 10.0 ** rng.uniform(-5.0, -4.0)
        contact = replace(scene.contact, law=law, restitution=restitution)
        scene = replace(scene, contact=contact, run=replace(scene.run, t_end=0.1))
        exact = Bench(scene)
        exact.advance([])
        fixed = Bench(replace(scene, run=replace(scene.run, method="rk4", step=step)))
        try:
            fixed.advance([])
        except SimulationError:
            continue
        accepted += 1
        assert loads(fixed) == pytest.approx(loads(exact), rel=0.1)
    assert accepted >= 20


def test_a_run_with_fixed_steps_whose_ledger_does_not_close_is_an_error():
    """A chattering tip: 10 % of the energy is lost at this step, 3 % at a quarter of it."""
    scene = wide_scenes(65, seed=50)[64]
    bench = Bench(replace(scene, run=replace(scene.run, t_end=0.5, method="rk4", step=4e-5)))
    with pytest.raises(SimulationError, match=r"run.step is too long: the energy ledger deviates"):
        bench.advance([])
    assert bench.events[-1].kind.label == "end"
