"""A contact outside of the bench: a plate, its closed forms, and a loop on it in one process."""

import cmath
import math

from capture_sim import load_scene
from capture_sim.hardware.guard import LoopLimits
from capture_sim.hardware.law import NO_LAW, WallLaw
from capture_sim.hardware.loop import Loop, run_in_process
from capture_sim.hardware.rig import IDEAL, Rig, Transport
from capture_sim.hardware.stage import LoopStage
from capture_sim.scene.laws import exact_factor

STEP = 1e-3  # s
SPEED = 0.1  # m/s
#: Limits that none of these contacts reaches.
WIDE = LoopLimits(
    1e3, 1e6, 1e6, speed=100.0, acceleration=1e6, latency=1.0, angular_speed=1e3, depth=1.0
)


def plate_scene(*overrides):
    """A stiff probe, 20 mm before the plate, so that a slow servo is at speed when it comes."""
    return load_scene(
        "_loop", ["initial.target.x=0.4825", "buffer.k_A=1e7", "buffer.c_A=2670", *overrides]
    )


def plate_mass(scene):
    """Return the mass that the plate feels, kg: the chaser head on, the target off its centre."""
    off = scene.initial.target.y - scene.initial.chaser.y
    yields = 1.0 / scene.chaser_total_mass + 1.0 / scene.target.mass
    return 1.0 / (yields + off**2 / scene.target.inertia)


def plate_law(mass, duration, restitution=1.0, offset=0.0):
    """Return the plate whose elastic touch lasts so long (s), with this restitution at 0.1 m/s."""
    stiffness = mass * (math.pi / duration) ** 2
    damping = exact_factor(restitution) * stiffness / SPEED if restitution < 1.0 else 0.0
    return WallLaw(stiffness, damping=damping, offset=offset)


SCENE = plate_scene()
MASS = plate_mass(SCENE)


def vehicles_restitution(stage):
    """Return how the vehicles part over how they met, by their momentum.

    Head on, beside the target's axis.  Nothing pushes the chaser sideways: its speed follows from
    the target's.
    """
    scene, v = stage.scene, stage.v
    momentum = scene.chaser_total_mass * SPEED
    chaser = (momentum - scene.target.mass * v[5]) / scene.chaser_total_mass
    off = scene.initial.target.y - scene.initial.chaser.y
    return (v[5] + v[7] * off - chaser) / SPEED


def restitution_on(law, t_end=1.0, scene=None):
    """Return the restitution of the vehicles on walls of a law, without a rig."""
    stage = LoopStage(scene or SCENE, STEP)
    stage.set_law(law)
    while stage.t < t_end:
        stage.take_step()
    return vehicles_restitution(stage)


def close(scene, rig, method="none", law=NO_LAW, limits=WIDE, t_end=1.0, step=STEP):
    """Close a loop in one process; return it and why it stopped."""
    loop = Loop(LoopStage(scene, step), method, law, limits)
    return loop, run_in_process(loop, rig, t_end)


def close_often(n, guess, rig_of, t_end, limits=WIDE):
    """Close n loops with model, each from the law that the one before has found.

    ``rig_of`` makes the rig of a number from 0 on.  Return the loops and why they stopped.
    """
    loops = []
    for number in range(n):
        loop, why = close(SCENE, rig_of(number), "model", guess, limits, t_end)
        loops.append((loop, why))
        guess = loop.estimate.law
    return loops


def ideal_rig(scene, law, delay=0.0, **figures):
    """Return a rig without servo, noise and bias that answers so late, s."""
    servo, cell, _ = IDEAL
    return Rig(scene, law, servo, cell, Transport(delay, 0.0, 0.0, 0.0), **figures)


def predicted_restitution(duration, response):
    """Return the restitution of an elastic plate through a rig, in closed form.

    ``response(s)`` is the transfer function from the tip to where the rig has it when the force
    comes back.  The root of s^2 + (pi / T)^2 response(s) = 0 next to j pi / T, s = a + j b, gives
    exp(pi a / b): what the oscillation grows by in its half period.
    """
    w = math.pi / duration
    s = 1j * w
    for _ in range(200):
        new = 1j * w * cmath.sqrt(response(s))
        s = 0.5 * (s + new)
    return math.exp(math.pi * s.real / s.imag)


def response_of(rig, latency, prediction_lag=None):
    """Return the transfer function of a rig, of the hold of a step, and of the prediction.

    ``latency`` (s) is that of the transport, in whole steps.
    """

    def response(s):
        servo, cell = rig.servo, rig.cell
        delay = servo.delay + latency + rig.hidden_lag + 0.5 * STEP
        value = cmath.exp(-s * delay)
        if servo.bandwidth:
            w = 2.0 * math.pi * servo.bandwidth
            value *= cmath.exp(-0.5 * s * STEP)  # it holds each command for a step
            value *= w * w / (s * s + 2.0 * servo.damping_ratio * w * s + w * w)
        if cell.cutoff:
            value /= 1.0 + s / (2.0 * math.pi * cell.cutoff)
        if prediction_lag is not None:
            value *= 2.0 - cmath.exp(-s * prediction_lag)
        return value

    return response


def recorded_poses(loop):
    """Return the list of the positions that a loop is going to send, from its start on."""
    poses, advance = [], loop.advance

    def recorded():
        poses.append(advance())
        return poses[-1]

    loop.advance = recorded
    return poses
