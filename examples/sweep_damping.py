"""Which axial damping captures? Sweeps c_A of the paper's designed buffer and plots it."""

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

import capture_sim

table = capture_sim.sweep("paper_designed", {"buffer.c_A": np.linspace(0.0, 28.0, 15)})
captured = table["verdict"] == "captured"

figure, axes = plt.subplots(layout="constrained")
for rows, marker, label in ((captured, "o", "captured"), (~captured, "x", "not captured")):
    closest = table["nearest_distance"][rows] * 1e3
    axes.plot(table["buffer.c_A"][rows], closest, marker, label=label)
axes.set(xlabel="c_A in N s/m", ylabel="closest approach to BE in mm")
axes.legend()
figure.savefig("sweep_damping.png")
print(f"captured {captured.sum()} of {len(table)}")
