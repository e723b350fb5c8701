"""Which axial damping captures? Sweeps c_A of the paper's designed buffer and plots it."""

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

import capture_sim

damping = np.linspace(0.0, 28.0, 15)  # N s/m
runs = [capture_sim.simulate("paper_designed", {"buffer.c_A": c_A}) for c_A in damping]
nearest = np.array([run.summary["nearest_distance"] for run in runs])  # m
captured = np.array([run.summary["verdict"] == "captured" for run in runs])

figure, axes = plt.subplots(layout="constrained")
axes.plot(damping[captured], nearest[captured] * 1e3, "o", label="captured")
axes.plot(damping[~captured], nearest[~captured] * 1e3, "x", label="not captured")
axes.set(xlabel="c_A in N s/m", ylabel="nearest distance to BE in mm")
axes.legend()
figure.savefig("sweep_damping.png")
print(f"captured {captured.sum()} of {len(runs)}")
