"""Two ways to add a contact law of your own.

1. Most laws in the literature are F = K delta^1.5 (1 + a(e) delta' / v_0), and differ only in their
   hysteresis factor a(e).  The field `contact.hysteresis_factor` takes any a, in everything that
   capture_sim does.
2. Another dependence on the rate is computed here, step by step, and applied to vehicles and buffer
   as a wrench on the tip.  For another elastic force see examples/own_contact.py.  Limits: a scene
   with a rail begins at its end (docs/hardware_in_the_loop.md); touches are not located; the wrench
   is held over a step, which acts as a delay of half a step and generates energy, so halve the step
   and compare.
"""

import math

import capture_sim
from capture_sim.hardware.law import Walls, Wrench
from capture_sim.hardware.stage import LoopStage


def safaeifar(e):
    """Return a(e) of Safaeifar and Farshidianfar (2020), which the package does not have."""
    return 1.25 * (1.0 - e) / e


def lining(delta, rate):
    """Return the force (N) of a lined cone at a penetration (m) and its rate (m/s)."""
    return max(2e4 * delta + 5.0 * rate, 0.0)


def first_peak(scene, law, step):
    """Return the peak force (N) of the first touch by a law, with steps of ``step`` s."""
    stage, walls = LoopStage(scene, step), Walls(scene)
    peak = 0.0
    while stage.t < scene.run.t_end:
        tip, fx, fy = stage.tip, 0.0, 0.0
        for wall in walls.penetrations(tip):
            force = law(wall.depth, wall.rate) if wall.depth > 0.0 else 0.0
            fx, fy = fx + force * wall.nx, fy + force * wall.ny
        if peak > 0.0 and fx == fy == 0.0:
            break
        peak = max(peak, math.hypot(fx, fy))
        stage.take_step(Wrench(fx, fy))
    return peak


if __name__ == "__main__":
    run = capture_sim.simulate("paper_designed", {"contact.hysteresis_factor": safaeifar(0.5)})
    print(f"Safaeifar: {run.summary['verdict']}, peak {run.summary['max_normal_force']:.1f} N")
    for step in (2e-5, 1e-5):
        peak = first_peak(capture_sim.load_scene("paper_designed"), lining, step)
        print(f"lined cone, steps of {step:g} s: first peak {peak:.3f} N")
