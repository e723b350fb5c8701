"""A contact outside of the bench, as a rig has it: what it feels, and its first touch."""

from capture_sim.hardware.closed_loop import Loop, close, late
from capture_sim.hardware.in_the_loop import LoopStage
from capture_sim.hardware.walls import contact_rig


def plate_mass(scene):
    """Return the mass that the plate feels, kg: the chaser head on, the target off its centre."""
    off = scene.initial.target.y - scene.initial.chaser.y
    yields = 1.0 / scene.chaser_total_mass + 1.0 / scene.target.mass
    return 1.0 / (yields + off**2 / scene.target.inertia)


def first_touch(scene, law, lag, step, t_end, substeps, mass=None):
    """Close the loop in one process, a rig that answers ``lag`` steps late; its first touch."""
    loop = Loop(LoopStage(scene, step, substeps), mass=mass)
    close(loop, late(contact_rig(scene, law), lag), t_end, touches=1)
    return loop.touches[0]
