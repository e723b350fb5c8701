"""What takes the delay out of a loop: each way by itself, and all on the loop-back rig."""

import functools
import itertools
import math

import numpy as np
import pytest
from plate import plate_mass

from capture_sim import load_scene
from capture_sim.engine.held_wrench import N_LOOP
from capture_sim.errors import CaptureSimError
from capture_sim.hardware.closed_loop import Loop, close, late
from capture_sim.hardware.compensation import (
    Compensation,
    ContactFit,
    compensation,
    critical_damping,
    critical_delay,
    passive_share,
    predicted,
)
from capture_sim.hardware.in_the_loop import LoopStage
from capture_sim.hardware.walls import NOTHING, TipState, Touching, WallLaw, Walls, contact_rig

PLATE = 2000.0  # N/m
WAYS = (
    "passivity",
    "hybrid",
    "prediction1",
    "prediction2",
    "model",
    "model+passivity",
    "prediction2+passivity",
)


class Met:
    """A contact, and what is assumed of it."""

    def __init__(self, scene, law, duration, t_end, stick, mute, mass=None):
        self.scene, self.law, self.t_end, self.mass = scene, law, t_end, mass
        self.stick, self.mute = stick, mute  # N; s, in the middle of a touch
        self.felt = mass or LoopStage(scene).effective_mass(1.0, 0.0)
        self.linear = self.felt * (math.pi / duration) ** 2

    def loop(self, way, lag, *, true=None, stick=0.0, law=None, t_end=None, wrap=None):
        """Close it, with a rig of the law ``true``; ``wrap(loop, channel)`` changes what comes."""
        chosen = compensation(way)
        if law is None and chosen.hybrid:
            law = WallLaw(0.0, drag=critical_damping(self.felt, self.linear, (lag + 0.5) * 1e-3))
        loop = Loop(LoopStage(self.scene, 1e-3, 40), chosen, law or self.law, mass=self.mass)
        rig = contact_rig(self.scene, true or self.law)
        channel = late(sticky(rig, Walls(self.scene), stick) if stick else rig, lag)
        close(loop, wrap(loop, channel) if wrap else channel, t_end or self.t_end + 4e-3 * lag)
        return loop


def sticky(rig, walls, stick):
    """A rig that also holds the tip back by ``stick`` (N) while it comes out of a wall."""

    def wrench(tip):
        fx, fy, torque = rig(tip)
        for wall in walls.touching(tip):
            if wall.rate < 0.0:
                fx, fy = fx - stick * wall.nx, fy - stick * wall.ny
        return fx, fy, torque

    return wrench


# slow: at a delay of a whole touch the tip is to stay within the plate's reach, 15 mm
SLOW = load_scene("_loop", ["initial.chaser.vx=0.02"])
PAPER = load_scene("paper_designed")


@functools.cache
def contact(name):
    """The soft plate, 235 ms in touch, once; the paper's contact, 0.3 ms, again and again."""
    if name == "plate":
        return Met(SLOW, WallLaw(PLATE), 0.235, 1.0, 0.6, 340, plate_mass(SLOW))
    return Met(PAPER, WallLaw(PAPER.contact_stiffness, 1.5), 3.3e-4, 0.1, 20.0, 2)


@functools.cache
def exact(law):
    """The law of the plate in the vehicles' own steps, nothing late."""
    loop = Loop(LoopStage(SLOW, 1e-3, 40), mass=plate_mass(SLOW))
    loop.stage.take_law(law, gated=False)
    close(loop, lambda k, place: (place.t, NOTHING), 1.0)
    return loop


def parting(loop):
    """The vehicles' speed apart, m/s: of their own bodies, the probe rings."""
    return loop.stage.v[5] - loop.stage.v[0]


# names


def test_names_are_joined_and_wrong_ones_refused():
    assert compensation("none") == Compensation()
    assert compensation("prediction2+passivity") == Compensation(passivity=True, prediction=2)
    with pytest.raises(CaptureSimError, match="'damping': must be one of none, passivity, hybrid"):
        compensation("damping")
    with pytest.raises(CaptureSimError, match="exclude each other"):
        compensation("model+hybrid")


# critical delay


@pytest.mark.parametrize("damping, virtual", [(0.0, 40.0), (40.0, 0.0), (25.0, 15.0)])
def test_the_critical_delay_is_an_imaginary_root(damping, virtual):
    m, k = 11.17, 2000.0
    tau = critical_delay(m, k, damping, virtual)

    def characteristic(s):
        return m * s**2 + virtual * s + (damping * s + k) * np.exp(-s * tau)

    w = np.linspace(1.0, 40.0, 400_001)
    size = np.abs(characteristic(1j * w))
    assert size.min() < 1e-3 * k
    # nothing less late grows: its roots near there lie to the left
    assert tau == pytest.approx((damping + virtual) / k, rel=0.1)


def test_the_critical_damper_undoes_the_critical_delay():
    for tau in (1e-3, 2e-2, 0.2):
        virtual = critical_damping(11.17, 2000.0, tau)
        assert critical_delay(11.17, 2000.0, virtual=virtual) == pytest.approx(tau, rel=1e-12)


def test_at_the_critical_delay_a_loop_swings_on():
    """A plate that pulls as well; damper in the vehicles' steps, spring late."""
    mass, lag = plate_mass(SLOW), 10
    walls = Walls(SLOW)
    gains = []
    for share in (0.8, 1.0, 1.2):
        drag = share * critical_damping(mass, PLATE, (lag + 0.5) * 1e-3)
        stage = LoopStage(SLOW, 1e-3, 40)
        begin = stage.saved()
        begin.y[0] += 0.01  # 5 mm behind the plate's face
        stage.restore(begin)
        loop = Loop(stage)
        stage.take_law(WallLaw(0.0, drag=drag), gated=False)

        def pulling(tip):
            (wall,) = walls.touching(tip)
            force = PLATE * (wall.penetration - 0.005)
            return force * wall.nx, force * wall.ny, 0.0

        speeds = []
        channel = late(pulling, lag)
        for k in range(1500):
            loop.advance(*channel(k, loop.place))
            speeds.append(abs(loop.stage.v[0] - loop.stage.v[5]))
        # one swing takes 470 ms
        gains.append(max(speeds[1000:1500]) / max(speeds[500:1000]))
    assert gains[0] > 1.02
    assert gains[2] < 0.98
    assert gains[1] == pytest.approx(1.0, abs=0.01)


# passivity


@pytest.mark.parametrize("allowed", [1.0, 0.0, -0.1, -0.5, -5.0])
@pytest.mark.parametrize("slope, bend", [(-2.0, 1.5), (-2.0, 0.0), (1.0, 0.3), (-2.0, 1500.0)])
def test_the_share_does_what_is_allowed_and_stays_near_the_wanted(slope, bend, allowed):
    """Against all shares tried one by one."""
    for low, high, wanted in ((0.0, 2.0, 1.0), (-1.0, 0.0, 0.0)):
        shares = np.linspace(low, high, 200_001)
        works = shares * (slope + shares * bend)
        good = shares[works <= max(allowed, works.min())]
        nearest = good[np.argmin(np.abs(good - wanted))]
        share = passive_share(slope, bend, low, high, wanted, allowed)
        assert share == pytest.approx(nearest, abs=1.1e-5)
        assert share * (slope + share * bend) <= max(allowed, works.min()) + 1e-8


@pytest.mark.parametrize("lag", [0, 5, 20, 60, 235])
def test_passivity_gives_back_what_a_plate_took(lag):
    loop = contact("plate").loop("passivity", lag)
    assert loop.work == pytest.approx(0.0, abs=2e-3 * loop.touches[0].energy)
    assert parting(loop) == pytest.approx(parting(exact(WallLaw(PLATE))), rel=0.05)


@pytest.mark.parametrize("damping", [0.0, 0.3 * PLATE / 0.1])
@pytest.mark.parametrize("lag", [0, 5, 20])
def test_the_observer_knows_what_the_rig_has_given(lag, damping):
    """Late, by the stamps, against the work along the path."""
    law, places = WallLaw(PLATE, damping=damping), []

    def noted(loop, channel):
        return lambda k, place: places.append(place) or channel(k, place)

    (touch,) = contact("plate").loop("none", lag, true=law, wrap=noted).touches[:1]
    taken = path_work(contact_rig(SLOW, law), places)
    assert touch.port == pytest.approx(min(taken, 0.0), abs=2e-3 * touch.energy)


def path_work(rig, places):
    """Work of a contact along cubic paths between the places, by Gauss's rule."""
    s, w = np.polynomial.legendre.leggauss(8)
    total = 0.0
    for a, b in itertools.pairwise(places):
        h = b.t - a.t
        for u, weight in zip(0.5 * (s + 1.0), 0.5 * w, strict=True):
            at = TipState(0.0, *(p + (q - p) * u for p, q in zip(a[1:], b[1:], strict=True)))
            fx, fy, torque = rig(at)
            total += weight * h * (fx * at.vx + fy * at.vy + torque * at.omega)
    return total


def test_passivity_turns_the_paper_contact_at_1_khz():
    """The impulse of a touch a third of a step long is that of the true contact."""
    true = Loop(LoopStage(PAPER, 1e-5, 10))
    close(true, late(contact_rig(PAPER, contact("paper").law), 0), 0.005, 1)
    loop = contact("paper").loop("passivity", 0)
    assert len(loop.touches) >= 4
    assert loop.touches[0].impulse == pytest.approx(true.touches[0].impulse, rel=0.05)
    assert all(touch.restitution == pytest.approx(1.0, abs=1e-3) for touch in loop.touches)


# prediction


def test_a_parabola_is_foretold():
    def at(t):
        return TipState(0.0, 1 + 2 * t + 3 * t**2, -t, 4 * t**2, 2 + 6 * t, -1.0, 8 * t)

    now = at(0.1)
    got = predicted(now, 0.05, np.array(now[4:]), np.array([6.0, 0.0, 8.0]))
    assert got == pytest.approx(at(0.15))


@pytest.mark.parametrize("way", ["prediction1", "prediction2"])
def test_prediction_takes_most_of_a_small_delay(way):
    for lag in (0, 2, 5):
        loop = contact("plate").loop(way, lag)
        assert parting(loop) == pytest.approx(parting(exact(WallLaw(PLATE))), rel=2e-3)


# the fit


def test_stiffness_damping_and_friction_are_found():
    true = WallLaw(5e4, 1.5, damping=2e5, friction=0.25)
    fit = ContactFit(WallLaw(1e4, 1.5), noise=0.05)
    rng = np.random.default_rng(3)
    for _ in range(300):
        wall = Touching(rng.uniform(1e-3, 5e-3), rng.normal() * 0.05, 0.6, 0.8, rng.normal(), 0.01)
        normal = wall.penetration**1.5 * (true.stiffness + true.damping * wall.rate)
        rub = -true.friction * normal * math.tanh(wall.slip / true.slip_speed)
        noise = rng.normal(size=2) * 0.05
        fx, fy = normal * wall.nx - rub * wall.ny, normal * wall.ny + rub * wall.nx
        fit.learn(wall, (fx + noise[0], fy + noise[1], 0.0))
    assert fit.law.stiffness == pytest.approx(true.stiffness, rel=0.01)
    assert fit.law.damping == pytest.approx(true.damping, rel=0.05)
    assert fit.law.friction == pytest.approx(true.friction, rel=0.01)


def test_a_fit_never_makes_energy():
    fit = ContactFit(WallLaw(1e4, 1.0))
    wall = Touching(1e-3, 0.1, 1.0, 0.0, 0.1, 0.01)
    for _ in range(50):  # less force while it is pushed in than while it comes out
        fit.learn(wall, (5.0, 5.0, 0.0))
        fit.learn(wall._replace(rate=-0.1), (15.0, 5.0, 0.0))
    assert fit.law.damping == 0.0
    assert fit.law.friction == 0.0
    assert fit.law.stiffness > 0.0


def test_the_law_in_the_vehicles_steps_is_the_law():
    """Compiled, and as a wrench held over a step so short that nothing changes."""
    law = WallLaw(PAPER.contact_stiffness, 1.5, 8.0 * PAPER.contact_stiffness, 20.0, 0.3)
    walls = Walls(PAPER)
    stage = LoopStage(PAPER, 1e-11, 1)
    rng = np.random.default_rng(5)
    q, v, rest, begin = stage.q, stage.v, np.zeros(N_LOOP - 16), stage.saved()
    for _ in range(20):
        push = [2e-4 + 1e-4 * rng.random(), 0, 0, 0, 0, 0, 0, 0]  # the wall is 0.1 mm away
        moved = np.concatenate([q + push, v + 0.05 * rng.normal(size=8), rest])
        stage.restore(begin._replace(y=moved))
        state, tip = stage.saved(), stage.tip
        assert len(walls.touching(tip)) == 1
        found = []
        for inside, wrench in ((law, NOTHING), (WallLaw(0.0), walls.wrench(law, tip))):
            stage.restore(state)
            stage.take_law(inside, gated=False)
            stage.advance(wrench)
            found.append(stage.v - state.y[8:16])
        assert found[0] == pytest.approx(found[1], rel=1e-5, abs=1e-12)


@pytest.mark.parametrize("guess", [0.1, 0.5, 2.0, 10.0])
@pytest.mark.parametrize("lag", [0, 5])
def test_the_model_takes_the_paper_contact_at_1_khz(guess, lag):
    """0.3 ms in touch, answers every 1 ms: within 1 % of the model's after three touches."""
    met = contact("paper")
    law = met.law._replace(stiffness=guess * met.law.stiffness)
    loop = met.loop("model", lag, law=law)
    assert loop.fit.law.stiffness == pytest.approx(met.law.stiffness, rel=1e-3)
    assert len(loop.touches) > 4
    for touch in loop.touches[3:]:
        assert touch.restitution == pytest.approx(1.0, abs=0.01)


def test_the_model_finds_what_a_contact_loses():
    """Against the same law integrated truly, in steps of 10 us."""
    met = contact("paper")
    law = met.law._replace(damping=3.0 * met.law.stiffness)
    true = Loop(LoopStage(PAPER, 1e-5, 10))
    true.stage.take_law(law, gated=False)
    close(true, lambda k, place: (place.t, NOTHING), 0.1, 8)
    loop = met.loop("model", 1, true=law)
    assert loop.fit.law.damping == pytest.approx(law.damping, rel=1e-3)
    for touch, other in zip(loop.touches[3:], true.touches[3:], strict=False):
        assert touch.restitution == pytest.approx(other.restitution, rel=0.02)


@pytest.mark.parametrize("lag", [20, 235])
@pytest.mark.parametrize("damping", [0.0, 0.5 * PLATE / 0.1])
def test_the_model_takes_a_delay_of_a_whole_touch(lag, damping):
    """The second shot, with what the first has found from a guess wrong by two."""
    law, met = WallLaw(PLATE, damping=damping), contact("plate")
    first = met.loop("model", lag, true=law, law=WallLaw(0.5 * PLATE))
    second = met.loop("model", lag, true=law, law=first.fit.law)
    assert parting(second) == pytest.approx(parting(exact(law)), rel=0.005)
    touch, true = second.touches[0], exact(law).touches[0]
    assert touch.peak_force == pytest.approx(true.peak_force, rel=0.01)
    assert touch.impulse == pytest.approx(true.impulse, rel=0.005)


# safety


def test_a_damper_beyond_what_the_steps_carry_is_refused():
    with pytest.raises(CaptureSimError, match=r"drag = 40000 N s/m: must be <= 1861"):
        Loop(LoopStage(PAPER), compensation("hybrid"), WallLaw(0.0, drag=4e4))


def with_a_fault(name, way, case, lag):
    """A rig that is not what is assumed; what the loop makes in all, and at most meanwhile, J."""
    met, most, last, runs = contact(name), [0.0], [], []
    share = {"stiffer": 2.0, "weaker": 0.5}.get(case, 1.0)

    def watched(loop, channel):
        go = loop.stage.go
        loop.stage.go = lambda *wrench: runs.append(1) or go(*wrench)

        def came(k, place):
            most.append(loop.work)
            assert len(runs) <= 4  # three of them tried, or it does not keep up at 1 kHz
            runs.clear()
            new = channel(k, place)
            if not (case == "silent" and met.mute <= k < met.mute + 50):
                last[:] = [new]
            return last[0]

        return came

    true = met.law._replace(stiffness=share * met.law.stiffness)
    stick, t_end = met.stick if case == "sticky" else 0.0, min(met.t_end, 0.65)
    loop = met.loop(way, lag, true=true, stick=stick, t_end=t_end, wrap=watched)
    assert loop.stage.impulse > 0.0
    return loop.work, max(loop.work, *most)


uncompensated = functools.cache(with_a_fault)


@pytest.mark.parametrize("case", ["stiffer", "weaker", "sticky", "silent"])
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", ["plate", "paper"])
def test_no_way_makes_energy(name, way, case):
    """At no moment, with answers 0.5 to 20.5 ms late; and with none of these more than without."""
    approach = 0.5 * contact(name).felt * (0.02 if name == "plate" else 0.07) ** 2
    # a law in the vehicles' own steps is as exact as those: 12 of them in a touch of 0.3 ms
    bound = 2.5e-3 if "model" in way and name == "paper" else 1e-7
    for lag in (0, 2, 5, 20):
        if "hybrid" in way and name == "paper" and lag > 0:
            continue  # needs a damper that is refused
        work, most = with_a_fault(name, way, case, lag)
        assert most <= bound * approach, lag
        assert work <= uncompensated(name, "none", case, lag)[0], lag
