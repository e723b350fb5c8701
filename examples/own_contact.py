"""A lining, a lip and a measured curve in place of Hertz's contact; docs/own_contact.md."""

import numpy as np

import capture_sim

LINING = [[0, 0], ["0.2 mm", "4 N"], ["0.2 mm", "4 N"], ["2 mm", "400 N"]]
LIP = [[0, 0], ["0.1 mm", "2 N"], ["0.3 mm", "2.5 N"], ["0.6 mm", "20 N"], ["1 mm", "90 N"]]
#: One impact without damping: its first touch is over after 3 ms.
ELASTIC = {"contact.hysteresis_factor": 0.0, "run.t_end": 0.003}


def measured(stiffness, deepest, count):
    """Return points of Hertz's force (m, N), as a press would measure it, densest near 0."""
    depths = deepest * np.linspace(0.0, 1.0, count) ** 2
    return [[d, stiffness * d**1.5] for d in depths.tolist()]


def first_touch(changes):
    """Return peak force (N) and duration (s) of the first touch."""
    touch = capture_sim.simulate("paper_designed", changes).touches[0]
    return touch["peak_force"], touch["end"] - touch["start"]


def errors(count):
    """Return the relative errors of peak and duration with a table of so many points."""
    K = capture_sim.load_scene("paper_designed").contact_stiffness
    peak, duration = first_touch(ELASTIC)
    table = measured(K, 1.5 * (peak / K) ** (2 / 3), count)
    found = first_touch({**ELASTIC, "contact.force_table": table})
    return abs(found[0] / peak - 1.0), abs(found[1] / duration - 1.0)


if __name__ == "__main__":
    for name, table in (("lining", LINING), ("lip", LIP)):
        run = capture_sim.simulate("paper_designed", {"contact.force_table": table})
        peak, depth = run.summary["max_normal_force"], 1e3 * run.summary["max_penetration"]
        print(f"{name}: {run.summary['verdict']}, peak {peak:.1f} N at {depth:.2f} mm")
    for count in (8, 16, 32, 64):
        force, duration = errors(count)
        print(f"| {count} | {force:.1e} | {duration:.1e} |")
