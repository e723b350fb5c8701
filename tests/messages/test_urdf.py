"""The robot description: its tree, its frames and its plates, against the core."""

import math
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from capture_sim import load_scene, simulate
from capture_sim.messages.urdf import moving_transforms, static_transforms, urdf
from capture_sim.scene.loading import load_scene_text


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
    lip = inner + cone.L_c * np.array([-math.cos(cone.half_angle), math.sin(cone.half_angle)])
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
