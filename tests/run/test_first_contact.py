"""The first contact, by what happens: chatter, a longer pause, the other wall."""

import numpy as np
import pytest

from capture_sim import EventKind, load_scene, simulate
from capture_sim.dynamics.bench import Bench
from capture_sim.dynamics.drive import drive
from capture_sim.dynamics.samples import TOUCH
from capture_sim.run.first_contact import first_cluster, first_contact_end


def touches(*rows):
    """Return touches of (start, end, wall)."""
    made = np.zeros(len(rows), TOUCH)
    for touch, (start, end, wall) in zip(made, rows, strict=True):
        touch["start"], touch["end"], touch["wall"] = start, end, wall
    return made


def bouncing(start, pause, ratio, count, lasts):
    """Return touches of 1 ms with pauses that shrink, the last one sustained."""
    rows = []
    for _ in range(count):
        rows.append((start, start + 1e-3, 1))
        start, pause = start + 1e-3 + pause, pause * ratio
    return [*rows, (start, start + lasts, 1)]


@pytest.mark.parametrize("ratio", [0.3, 0.7, 0.95])
@pytest.mark.parametrize("pause", [1e-3, 0.02, 0.08])
def test_shrinking_pauses_are_chatter_whatever_their_scale(pause, ratio):
    rows = bouncing(0.0, pause, ratio, 6, 5 * pause)
    again = rows[-1][1] + rows[-1][0] + 1e-3  # off for longer than it has chattered
    found = first_cluster(touches(*rows, (again, again + 0.1, 1)))
    assert found.size == 7
    found = first_cluster(touches(*rows, (rows[-1][1] + 0.5 * pause, again + 0.1, 1)))
    assert found.size == 8


def test_the_other_wall_ends_it_however_soon():
    rows = [*bouncing(0.0, 0.01, 0.5, 4, 0.1)]
    soon = rows[-1][1] + 1e-4
    assert first_cluster(touches(*rows, (soon, soon + 0.1, -1), (1.0, 1.1, 1))).size == 5


def test_a_rebound_is_not_joined_to_a_later_shorter_contact():
    assert first_cluster(touches((0.0, 0.001, 1), (1.0, 1.2, 1))).size == 1
    assert first_cluster(touches((0.0, 0.001, 1), (0.1, 0.3, 1))).size == 2
    assert first_cluster(touches((0.0, 0.001, 1))).size == 1
    assert first_cluster(touches()).size == 0


@pytest.mark.parametrize("name", ["paper_undamped", "paper_clamped", "tilt_m10"])
def test_a_run_under_way_knows_its_end_as_soon_as_it_can_be_said(name):
    scene = load_scene(name)
    whole = first_cluster(simulate(scene).touches)
    bench = Bench(scene)
    for piece in drive(bench, block=10):
        now = float(piece.samples["t"][-1])
        end = first_contact_end(bench.events, now)
        if end is not None:
            break
    assert end == whole["end"].max()
    later = [e.t for e in bench.events if e.kind is EventKind.TOUCH and e.t > end]
    span = whole["start"].max() - whole["start"].min()
    assert now - end < span + 0.011 or now - later[0] < 0.011


def test_two_walls_in_quick_succession_are_two_contacts():
    """45 ms after the first wall comes the second; a fixed 50 ms made one contact of both."""
    run = simulate("tilt_m10")
    first = first_cluster(run.touches)
    assert set(first["wall"].tolist()) == {-1}
    assert run.summary["first_contact_duration"] == pytest.approx(0.18957, rel=1e-3)
