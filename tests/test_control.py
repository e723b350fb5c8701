"""Pacing, control and the robot description, without ROS."""

import math
import threading
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from capture_sim import load_scene, simulate
from capture_sim.control.pacing import MOST_BEHIND, Pacer
from capture_sim.control.simulation_control import Code, RunCut, SimulationControl, State
from capture_sim.messages.urdf import moving_transforms, static_transforms, urdf
from capture_sim.scene.files import load_scene_text


class Clock:
    """A clock that only waiting and work move; waiting takes a little too long."""

    def __init__(self, late=0.0):
        self.now = 100.0
        self.late = late

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds + self.late


def paced(factor, late=0.0):
    clock = Clock(late)
    pacer = Pacer(factor, clock, clock.sleep)
    pacer.restart(0.0)
    return pacer, clock


@pytest.mark.parametrize("factor", [0.5, 1.0, 10.0])
def test_ticks_come_when_they_are_due_and_their_errors_do_not_add_up(factor):
    pacer, clock = paced(factor, late=5e-5)
    for k in range(1, 1001):
        pacer.wait_for(k * 1e-3)
        assert clock.now - 100.0 == pytest.approx(k * 1e-3 / factor + 5e-5, abs=1e-9)
    assert pacer.lateness().max == pytest.approx(5e-5, abs=1e-9)
    assert pacer.late_ticks(1e-3 / factor) == 0


def test_unpaced_never_waits():
    pacer, clock = paced(0.0)
    pacer.wait_for(1e6)
    assert clock.now == 100.0
    assert pacer.lateness() is None


def test_what_is_late_is_caught_up_with_and_what_is_too_late_is_given_up():
    pacer, clock = paced(1.0)
    clock.now += 0.5  # some work took long
    pacer.wait_for(0.1)
    assert clock.now == 100.5
    pacer.wait_for(1.0)
    assert clock.now == pytest.approx(101.0)  # caught up
    clock.now += 2.0 * MOST_BEHIND
    pacer.wait_for(1.1)
    assert pacer.given_up == pytest.approx(2.0 * MOST_BEHIND - 0.1)
    before = clock.now
    pacer.wait_for(1.3)
    assert clock.now - before == pytest.approx(0.2)
    assert pacer.late_ticks(0.05) == 2


def test_factor_may_change_on_the_way():
    pacer, clock = paced(1.0)
    pacer.wait_for(1.0)
    pacer.factor = 4.0
    pacer.wait_for(1.0)  # from here on
    pacer.wait_for(3.0)
    assert clock.now == pytest.approx(101.5)


# control


def stepping(control):
    """Step for ever in a thread; return what was passed, and how it was cut."""
    passed, cuts = [], []

    def work():
        try:
            while True:
                control.pass_sample()
                passed.append(control.state)
        except RunCut as cut:
            cuts.append(cut)
            control.end()

    control.begin()
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return passed, cuts, thread


def test_steps_are_counted_exactly():
    control = SimulationControl(State.PAUSED)
    passed, cuts, thread = stepping(control)
    for count in (1, 5, 100):
        before = len(passed)
        assert control.step(count).wait(5.0).code is Code.OK
        assert len(passed) == before + count
    assert control.set_state(State.STOPPED).wait(5.0).code is Code.OK
    thread.join(5.0)
    assert [(str(c), c.again, c.asked_for) for c in cuts] == [("stopped", False, True)]
    assert len(passed) == 106


def test_pause_is_answered_when_nothing_passes_any_more():
    control = SimulationControl(State.PLAYING)
    passed, _, thread = stepping(control)
    for _ in range(50):
        assert control.set_state(State.PAUSED).wait(5.0).code is Code.OK
        held = len(passed)
        assert control.step(2).wait(5.0).code is Code.OK
        assert len(passed) == held + 2
        assert control.set_state(State.PLAYING).wait(5.0).code is Code.OK
    control.set_state(State.QUITTING)
    thread.join(5.0)


def test_step_that_is_interrupted_says_how_far_it_came():
    control = SimulationControl(State.PAUSED)
    control.begin()
    step = control.step(3)
    control.pass_sample()
    assert control.step(1).wait(0.0).code is Code.OPERATION_FAILED  # one at a time
    reset = control.reset(0)
    assert "after 1 of 3 steps" in step.wait(0.0).message
    with pytest.raises(RunCut, match="reset") as cut:
        control.look()
    assert cut.value.again
    control.end()
    assert reset.wait(0.01).code is Code.OPERATION_FAILED  # not yet
    control.begin()
    control.ready()
    assert reset.wait(0.0).code is Code.OK


def test_nothing_is_possible_once_it_quits():
    control = SimulationControl(State.PLAYING)
    assert control.set_state(State.QUITTING).wait(0.0).code is Code.OK
    for request in (control.set_state(State.PLAYING), control.reset(0)):
        assert request.wait(0.0).code is Code.INCORRECT_STATE


def test_end_leaves_nobody_waiting():
    control = SimulationControl(State.PAUSED)
    control.begin()
    step = control.step(3)
    control.close()
    assert step.wait(0.0).code is Code.OPERATION_FAILED


# the robot description


@pytest.fixture(params=["tilt_p10", "paper_designed"])
def scene(request):
    return load_scene(request.param)


def rotation(rpy):
    """Return the matrix of URDF's fixed-axis roll, pitch and yaw."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def numbers(element, name):
    return np.array([float(x) for x in element.get(name).split()])


def test_description_is_one_tree_with_the_frames_of_the_messages(scene):
    robot = ET.fromstring(urdf(scene))
    links = [link.get("name") for link in robot.iter("link")]
    assert len(set(links)) == len(links)
    parents = {
        j.find("child").get("link"): j.find("parent").get("link") for j in robot.iter("joint")
    }
    assert set(parents) == set(links) - {"world"}
    for link in parents:
        seen = set()
        while link != "world":
            assert link not in seen
            seen.add(link)
            link = parents[link]
    assert {j.get("name"): j.get("type") for j in robot.iter("joint")}.items() >= {
        "buffer_hinge": "revolute",
        "buffer_slide": "prismatic",
    }.items()


def test_transforms_put_tip_and_cone_where_the_core_has_them(scene):
    result = simulate(scene)
    for sample in result.samples[::97]:
        chain = {t.child: t for t in (*moving_transforms(scene, sample["q"].tolist()),)}
        chain |= {t.child: t for t in static_transforms(scene)}

        def place(frame, chain=chain):
            if frame == "world":
                return np.zeros(2), 0.0
            t = chain[frame]
            origin, yaw = place(t.parent)
            c, s = math.cos(yaw), math.sin(yaw)
            moved = np.array([c * t.x - s * t.y, s * t.x + c * t.y])
            return origin + moved, yaw + t.yaw

        tip, _ = place("chaser/tip")
        cone, yaw = place("target/cone")
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = tip - cone
        assert -(c * dx + s * dy) == pytest.approx(sample["tip_axial"], abs=1e-12)
        assert c * dy - s * dx == pytest.approx(sample["tip_lateral"], abs=1e-12)


def test_plates_of_the_cone_lie_on_the_walls(scene):
    robot = ET.fromstring(urdf(scene))
    [link] = [link for link in robot.iter("link") if link.get("name") == "target/cone"]
    cone = scene.cone
    inner = np.array([0.0, cone.R_c])
    lip = inner + cone.L_c * np.array([-math.cos(cone.beta), math.sin(cone.beta)])
    count = 0
    for visual in link.iter("visual"):
        origin, box = visual.find("origin"), visual.find("geometry/box")
        at, turn = numbers(origin, "xyz"), rotation(numbers(origin, "rpy"))
        length, thick, width = numbers(box, "size")
        assert np.linalg.norm(turn[:, 0]) == pytest.approx(1.0)
        # the inner face's ends, in the half-plane of the axis
        ends = [at + turn @ [x * length / 2, y * thick / 2, 0] for x in (-1, 1) for y in (-1, 1)]
        flat = sorted((e[0], math.hypot(e[1], e[2])) for e in ends)
        for wanted in (inner, lip):
            assert min(math.dist(wanted, f) for f in flat) < 1e-6
        # no gap between neighbours at the lip
        assert width >= 2 * lip[1] * math.tan(math.pi / 16) - 1e-9
        count += 1
    assert count == 16


def test_description_needs_no_optional_part():
    scene = load_scene_text(load_scene("paper_designed").to_yaml())
    assert scene.stops is None
    limit = ET.fromstring(urdf(scene)).find("joint[@name='buffer_slide']/limit")
    assert float(limit.get("lower")) < 0 < float(limit.get("upper"))
