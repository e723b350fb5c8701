"""The controller of docking_controller.py without ROS: one docking, then 200 random starts."""

import sys
from pathlib import Path

import numpy as np
from docking_controller import NAMES, command

import capture_sim
from capture_sim.dynamics.drive import Control
from capture_sim.messages.convert import CHASER, TARGET, odometry

SCENE = Path(__file__).with_name("free_flyer.yaml")


def body(sample, which):
    """Return the numbers of a vehicle's odometry message."""
    columns = odometry(sample["q"][which][np.newaxis], sample["v"][which][np.newaxis])
    return tuple(float(columns[name][0]) for name in NAMES)


def answer(sample):
    """Return the commands for chaser and target, as the node does."""
    return command(body(sample, CHASER), body(sample, TARGET), sample["touches"] > 0), None


def make(scene):
    """Return the control of one run, for --control docking_sweep:make."""
    return Control(answer)


def dock(changes=()):
    """Return the run of the scene with this controller."""
    return capture_sim.simulate(SCENE, changes, control=Control(answer))


def starts(count, seed=1):
    """Return random offsets (m) and headings (rad) of the chaser, and headings of the target."""
    rng = np.random.default_rng(seed)
    for y, theta, target in rng.uniform(-1.0, 1.0, (count, 3)) * (0.05, 0.1, 0.1):
        yield {
            "initial.chaser.y": float(y),
            "initial.chaser.theta": float(theta),
            "initial.target.theta": float(target),
        }


if __name__ == "__main__":
    run = dock()
    print(f"{run.summary['verdict']}, first touch at {run.touches['approach_speed'][0]:.4f} m/s")
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    found = [dock(changes).summary["verdict"] for changes in starts(count)]
    print(f"captured: {found.count('captured')} of {count} starts")
