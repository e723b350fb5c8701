"""Where the contact's geometry is hardest: lip, inner edge, throat, both walls at once."""

import math
from dataclasses import replace

import numpy as np
import pytest
from four_bodies import jacobian, mass_matrix, momentum, probe_masses, tip
from set_ups import METHODS, altered, assert_conserved, first, outer_lip, run, turned

from capture_sim import load_scene
from capture_sim.scene.parts import Initial, PlanarState


def nearest_of_wall(scene, q, side):
    """The point of a wall nearest to the tip's centre, in the world; the wall as a segment."""
    cone = scene.cone
    x, y = outer_lip(scene, side)
    inner = q[5:7] + turned(q[7], -cone.L_T, side * cone.R_c)
    outer = q[5:7] + turned(q[7], x, y)
    along = outer - inner
    share = np.clip((tip(scene, q) - inner) @ along / (along @ along), 0.0, 1.0)
    return inner + share * along, share


def hitting(point, beside, heading, tilt, changes):
    """The tip flies at a wall's end, ``beside`` (m) off centre, along the chaser's heading.

    ``point`` is "lip" or "edge" of the -y wall; ``tilt`` turns the target (rad).
    """
    scene = load_scene("paper_designed", ["cone.half_angle=0.9"])  # whose sine is not its cosine
    x, y = outer_lip(scene, -1.0)
    if point == "edge":
        x, y = -scene.cone.L_T, -scene.cone.R_c
    reach = scene.buffer.hinge_offset + scene.rest_length
    ahead = 0.02 + scene.probe.tip_radius
    at = turned(heading, reach + ahead, beside) - turned(tilt, x, y)
    stiff = 71.7e13  # ten thousand times aluminium: an impact without duration, nearly
    there = {
        "buffer.c_A": 0.0,
        "contact.law": "exact",
        "contact.tip.E": stiff,
        "contact.wall.E": stiff,
        "friction.law": "none",
        "initial.chaser.theta": heading,
        "initial.chaser.vx": 0.1 * math.cos(heading),
        "initial.chaser.vy": 0.1 * math.sin(heading),
        "initial.target.x": float(at[0]),
        "initial.target.y": float(at[1]),
        "initial.target.theta": tilt,
        "run.t_end": 0.21 + ahead / 0.1,
        "run.rtol": 1e-10,
    }
    return altered(scene, there | changes)


IMPACTS = [
    ("lip", -0.006, 0.0, 0.0),
    ("lip", -0.002, 0.1, 0.2),
    ("lip", 0.008, -0.2, -0.1),
    ("lip", 0.0145, 0.0, 0.2),
    ("edge", -0.0135, 0.05, -0.1),
    ("edge", -0.0142, 0.0, 0.0),
    ("edge", -0.0149, 0.2, -0.2),
]


@pytest.mark.parametrize("e", [0.3, 1.0])
@pytest.mark.parametrize("point, beside, heading, tilt", IMPACTS)
def test_impact_on_lip_and_edge_is_that_of_rigid_bodies(point, beside, heading, tilt, e):
    """All eight rates after an oblique impact on a wall's end.

    Exact, for an impact without duration: the normal is the line from the end to the tip's
    centre, and p = -(1 + e) v_n / (J M^-1 J^T) along it, with mass matrix and Jacobian of
    the independent model.  The touch lasts some 10 us, in which the normal turns with the
    tip that glides past the end, and takes v_t^2 tau / R_t off the approach speed.
    """
    scene = hitting(point, beside, heading, tilt, {"contact.restitution": e})
    result = run(scene, t_eval=[])
    touch, lift = first(result, "touch"), first(result, "lift_off")
    q, v = touch.q, touch.v
    near, share = nearest_of_wall(scene, q, -1.0)
    assert share == (1.0 if point == "lip" else 0.0)
    assert np.linalg.norm(tip(scene, q) - near) == pytest.approx(scene.probe.tip_radius, abs=1e-14)
    normal = (tip(scene, q) - near) / scene.probe.tip_radius
    target = near - q[5:7]
    # rate of the gap: of the tip's centre against the end of the wall, along the normal
    probe = jacobian(scene, q)[6:9]
    ahead = probe_masses(scene)[1] * np.array([-math.sin(q[3]), math.cos(q[3])])
    J = normal @ (probe[:2] + np.outer(ahead, probe[2]))
    J[5:] = -normal[0], -normal[1], -(target[0] * normal[1] - target[1] * normal[0])
    M = mass_matrix(scene, q)
    assert result.touches["approach_speed"][0] == pytest.approx(-J @ v, rel=1e-12)
    p = -(1 + e) * (J @ v) / (J @ np.linalg.solve(M, J))
    after = v + np.linalg.solve(M, J) * p
    gliding = 0.1**2 * (lift.t - touch.t) / scene.probe.tip_radius
    near_by = gliding / result.touches["approach_speed"][0]
    assert near_by < 2e-3
    assert result.touches["impulse"][0] == pytest.approx(p, rel=near_by)
    assert lift.v - v == pytest.approx(after - v, abs=2 * near_by * np.abs(after - v).max())
    assert momentum(scene, lift.q, lift.v) == pytest.approx(momentum(scene, q, v), abs=1e-11)


def on_the_face():
    return load_scene("paper_designed", ["friction.law=none", "contact.restitution=1.0"])


def at_the_inner_edge():
    return altered(on_the_face(), {"initial.target.x": 0.5, "initial.target.y": 1e-3})


def at_the_outer_lip():
    soft = {"contact.restitution": 1.0, "contact.tip.E": 71.7e9, "contact.wall.E": 71.7e9}
    return hitting("lip", 0.008, -0.2, -0.1, soft | {"run.state_rate": 1e4})


@pytest.mark.parametrize(
    "scene, where", [(on_the_face, 0.6), (at_the_inner_edge, 0.0), (at_the_outer_lip, 1.0)]
)
def test_force_follows_the_normal_of_face_edge_and_lip(scene, where):
    """Exact at every sample of a run: depth, direction and size of the force.

    The wall is a segment: from its ends the normal turns with the tip, and passes into
    the face's without a jump.  ``where``: a place along the wall that must be among those
    touched.
    """
    scene = scene()
    result = run(scene, t_end=1.0)
    shares = []
    for s in result.samples:
        q = s["q"]
        force = np.zeros(2)
        for i, side in enumerate((1.0, -1.0)):
            near, share = nearest_of_wall(scene, q, side)
            away = tip(scene, q) - near
            depth = scene.probe.tip_radius - np.linalg.norm(away)
            assert s["penetration"][i] == pytest.approx(depth, abs=1e-14)
            if s["walls"] & (i + 1):
                force += scene.contact_stiffness * max(depth, 0) ** 1.5 * away / np.hypot(*away)
                shares.append(share)
        # 1e-15 m of place is up to 5e-5 N of force
        assert s["contact_force"] == pytest.approx(force, abs=1e-4)
    assert min(abs(share - where) for share in shares) < 0.02


@pytest.mark.parametrize("method", METHODS)
def test_centred_tip_passes_the_throat_it_fits_exactly(method):
    """Both walls at once: the only instant at which a tip can touch both, R_c = R_t.

    Exact: the gap to both edges is zero where the centre passes that of BE, and not less;
    so nothing changes by a bit, and the tip is captured.
    """
    how = {"initial.target.x": 0.5, "initial.target.y": 0.0, "run.method": method}
    result = run(altered(load_scene("paper_designed"), how), t_end=1.0)
    assert np.all(result.v == result.v[0])
    depths = result.samples["penetration"]
    assert depths[:, 0] == pytest.approx(depths[:, 1], abs=1e-17)
    assert depths.max() <= 0.0
    assert result.verdict == "captured"


@pytest.mark.parametrize("method", METHODS)
def test_tip_that_fits_the_throat_passes_it_in_any_direction(method):
    """Rounding lets it touch, and lift off again at the same instant.

    Exact bounds: those of a path that rounding and the tolerance move by 1e-12 m, which meets
    an edge at sqrt(2 1e-12 / R_c) of its speed.  In the first case touches piled up.
    """
    paper = load_scene("paper_designed", [f"run.method={method}"])
    rng = np.random.default_rng(38)
    cases = [
        (0.0, 0.0, 0.3, 0.2, 0.4293658809742014, 0.13281843133089133),
        (0.0, 0.0, 0.0, 0.1, 0.5, 0.0),
    ]
    for _ in range(8 if method == "rk4" else 40):  # with its many steps
        x, y, heading, distance = *rng.uniform(-1, 1, 2), rng.uniform(-3.1, 3.1), 0.46
        ahead = x + distance * math.cos(heading), y + distance * math.sin(heading)
        cases.append((x, y, heading, float(rng.uniform(0.05, 0.3)), *ahead))
    for x, y, heading, speed, target_x, target_y in cases:
        vx, vy = speed * math.cos(heading), speed * math.sin(heading)
        chaser = PlanarState(x=x, y=y, theta=heading, vx=vx, vy=vy)
        target = PlanarState(x=target_x, y=target_y, theta=heading)
        scene = replace(paper, initial=Initial(chaser, target))
        result = run(scene, t_end=0.3 / speed, t_eval=[0.0, 0.2 / speed])
        assert result.failure == ""
        assert len(result.events) < 30
        hardest = scene.contact_stiffness * 1e-12**1.5
        assert result.touches["peak_force"].max(initial=0.0) <= hardest
        assert result.v[-1] == pytest.approx(result.v[0], abs=3e-5 * speed)


@pytest.mark.parametrize("offset", [1e-18, 1e-15, 1e-12, 1e-9])
def test_throat_touched_by_less_than_a_nanometre(offset):
    """The tip passes off centre by ``offset`` and overlaps one inner edge by as much.

    Exact bound: the edge, elastic, does no work, and may not push harder than
    K offset^1.5, for half a chord of the overlap before and after BE.  What shows beyond
    is the integrator's: below a hundred times its tolerance.
    """
    changes = {
        "initial.target.x": 0.5,
        "initial.target.y": offset,
        "friction.law": "none",
        "contact.restitution": 1.0,
        "run.rtol": 1e-10,
    }
    scene = altered(load_scene("paper_designed"), changes)
    result = run(scene, t_end=1.0)
    assert result.failure == ""
    hardest = scene.contact_stiffness * (1.1 * offset + 3e-18) ** 1.5  # rounding of the gap
    assert result.touches["peak_force"].max(initial=0.0) <= hardest
    # R_t = R_c: half a chord is sqrt(2 R_t offset) of way at 0.1 m/s
    push = 2 * hardest * math.sqrt(2 * 0.015 * offset) / 0.1
    assert np.abs(result.v[-1, :3] - result.v[0, :3]).max() <= push / probe_masses(scene)[0] + 1e-9
    assert result.verdict == "captured"


@pytest.mark.parametrize("offset, method", [(1e-6, "dopri5"), (1e-4, "dop853"), (1e-3, "dopri5")])
def test_tip_wedged_in_the_throat_never_touches_both_walls(offset, method):
    """An elastic tip runs into the throat off centre and hits both edges in turn, often.

    Exact: it can not be pressed on both walls at once.  From one wall to the other through
    the tip's centre it is at least 2 R_c, so the depths add up to at most
    2 (R_t - R_c) = 0; and momentum and energy are kept, however often it bounces.
    """
    changes = {
        "initial.target.x": 0.5,
        "initial.target.y": offset,
        "friction.law": "none",
        "contact.restitution": 1.0,
        "buffer.c_A": 0.0,
        "run.method": method,
        "run.rtol": 1e-11,
    }
    scene = altered(load_scene("paper_designed"), changes)
    result = run(scene, t_end=1.0)
    assert result.failure == ""
    assert result.touches.size >= 2
    assert result.samples["penetration"].sum(axis=1).max() <= 1e-16
    assert np.all(result.samples["normal_force"].min(axis=1) == 0.0)
    assert_conserved(result, 1e-9)


@pytest.mark.parametrize("law", ["lankarani_nikravesh", "exact"])
def test_tip_pressed_into_the_throat_from_aside(law):
    """A wide run-in: many touches on both edges, damped; the ledger stays closed.

    Exact: energy and momentum; and a contact that gives back at most what it took.
    """
    changes = {"contact.law": law, "contact.restitution": 0.5, "run.rtol": 1e-11}
    changes |= {"initial.chaser.vx": 0.3, "initial.chaser.x": 0.0, "buffer.c_A": 0.0}
    scene = altered(load_scene("paper_designed"), changes)
    result = run(scene, t_end=1.0)
    assert {1, -1} <= set(result.touches["wall"].tolist())
    assert_conserved(result, 1e-9)
    assert result.touches["dissipated"].min() > 0.0
