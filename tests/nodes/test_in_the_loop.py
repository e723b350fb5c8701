"""The loop through its two nodes and DDS."""

import json
import signal
from collections import deque

import pytest
from plate import plate_mass

from capture_sim import load_scene
from capture_sim.hardware.closed_loop import Loop
from capture_sim.hardware.in_the_loop import LoopStage
from capture_sim.hardware.walls import WallLaw, contact_rig

PLATE = 2000.0  # N/m


@pytest.fixture(scope="module")
def plate():
    return load_scene("_loop")


def test_the_loop_closes_through_dds(start, tmp_path, plate):
    """A soft plate works; slowed down, so that a busy machine does not decide."""
    rig = start("contact_rig", lag=2)
    report = tmp_path / "report.json"
    loop = start(
        "loop_simulator",
        report=report,
        rtf=0.2,
        timeout=10.0,
        energy_limit=1e3,
        mass=plate_mass(plate),
    )
    assert loop.status() == 0, loop.text
    rig.process.send_signal(signal.SIGINT)
    assert rig.status() == 0
    found = json.loads(report.read_text())
    assert found["steps"] == 1000
    # what the same delays give in one process
    ages = [round(age / 1e-3) for age in found["ages"]]
    assert min(ages[5:]) >= 2
    loop = Loop(LoopStage(plate, 1e-3, 40), mass=plate_mass(plate))
    rules = contact_rig(plate, WallLaw(PLATE))
    places = deque([loop.place], maxlen=1001)
    for age in ages:
        place = places[-1 - age]
        places.append(loop.advance(place.t, rules(place)))
    assert found["touches"][0]["work"] == pytest.approx(loop.touches[0].work, rel=1e-9)
    assert found["touches"][0]["work"] > 0.0


def test_a_silent_rig_and_a_stiff_one_stop_the_vehicles(start):
    rig = start("contact_rig")
    loop = start("loop_simulator", overrides="[run.t_end=30]", rtf=0.5)
    loop.wait_for("the loop is closed")
    rig.process.kill()
    assert loop.status() == 1
    assert "s old: must be <= 0.02" in loop.text
    assert "Traceback" not in loop.text
    stiffness = load_scene("paper_designed").contact_stiffness
    start("contact_rig", scene="paper_designed", stiffness=stiffness, exponent=1.5)
    loop = start("loop_simulator", scene="paper_designed", rtf=0.2, timeout=10.0)
    assert loop.status() == 1
    assert "N came: must be <= 500" in loop.text


def test_the_model_takes_the_paper_contact_through_dds(start, tmp_path):
    """Touches of 0.3 ms, answers at 1 kHz, from a stiffness wrong by two; lateness does no harm."""
    stiffness = load_scene("paper_designed").contact_stiffness
    start("contact_rig", scene="paper_designed", stiffness=stiffness, exponent=1.5)
    report = tmp_path / "report.json"
    loop = start(
        "loop_simulator",
        scene="paper_designed",
        overrides="[run.t_end=0.08]",
        rtf=0.05,
        timeout=10.0,
        compensation="model",
        stiffness=0.5 * stiffness,
        report=report,
    )
    assert loop.status() == 0, loop.text
    touches = json.loads(report.read_text())["touches"]
    assert len(touches) > 4
    for touch in touches[3:]:
        assert touch["work"] == pytest.approx(0.0, abs=0.02 * touch["energy"])


def test_the_observer_stops_the_nodes(start):
    start("contact_rig", lag=30)
    loop = start("loop_simulator", rtf=0.5, timeout=10.0, energy_limit=0.001)
    assert loop.status() == 1
    assert "the wrench would have made" in loop.text
    assert "must be <= 0.001 J" in loop.text
    assert "Traceback" not in loop.text
