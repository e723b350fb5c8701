"""Plots of a calibration: each trial as measured and simulated, correlations, and prediction."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.patches import Rectangle

from capture_sim.run.series import PARTS
from capture_sim.studies.fit.result import INSEPARABLE
from capture_sim.viewing import style
from capture_sim.viewing.canvas import dress, new_figure, subplots

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from capture_sim.studies.fit.prediction import Prediction
    from capture_sim.studies.fit.result import Calibration

#: Residuals beyond this number of standard deviations are drawn at this number.
_SHOWN = 6.0
#: Series that rest before the contact.
_BUFFER = ("stroke", "torsion")
#: A measured series of twice this number of points or more is drawn with fewer.
_MAX_POINTS = 3000


def draw_calibration(found: Calibration) -> dict[str, Figure]:
    """Return the figures of a calibration by name.

    "values" has the fitted parameters with their errors.  There is one for each trial, under the
    name of its file, with the trial's number if that name is taken.  "correlation" is there if
    several parameters were fitted, "prediction" if a new trial was predicted.
    """
    assert found.problem is not None
    figures: dict[str, Figure] = {"values": _draw_values(found)}
    for number, trial in enumerate(found.problem.trials):
        name = Path(trial.name).stem or f"{number}"
        while name in (*figures, "correlation", "prediction"):
            name = f"{name}_{number}"
        figures[name] = _draw_trial(found, number)
    if len(found.names) > 1:
        figures["correlation"] = _draw_correlation(found)
    if found.prediction is not None:
        figures["prediction"] = _draw_prediction(found.prediction)
    return figures


def _draw_values(found: Calibration) -> Figure:
    """Return a figure of the fitted values against their starts, with one and two errors."""
    count = len(found.names)
    figure, [[axes]] = subplots(9.0, 1.4 + 0.42 * count, 1, 1, grid="x", font=11.5)
    for row, (value, error, begun, unit) in enumerate(
        zip(found.values, found.errors, found.begun, found.units, strict=True)
    ):
        size = abs(begun) / 100.0 if begun else abs(error) or 1.0
        at, half = (value - begun) / size, error / size
        if np.isfinite(half):
            axes.hlines(row, at - 2.0 * half, at + 2.0 * half, color=style.BLUE, lw=1.2)
            axes.hlines(row, at - half, at + half, color=style.BLUE, lw=4.0)
        axes.plot(at, row, "o", color=style.BLUE, ms=5)
        text = f"{value:.5g} +- {error:.2g} {'' if unit == '1' else unit}".rstrip()
        axes.annotate(text, (1.01, row), xycoords=("axes fraction", "data"), va="center")
    axes.axvline(0.0, color=style.GREY, lw=1.0)
    axes.set_yticks(range(count), found.names)
    axes.set_ylim(count - 0.4, -0.6)
    axes.set_xlabel("change from the start  [%; of a start at 0: standard errors]")
    title = "Fitted values, with one and two standard errors"
    axes.set_title(title if found.is_usable else f"{title}: NOT FOUND, do not use", fontsize=12)
    return figure


#: What the panels of a contact show, s before and after it.
_CONTACT = (0.02, 0.3)


def _draw_trial(found: Calibration, number: int) -> Figure:
    """Return the figure of a trial: what was measured and simulated, the contact, the residuals.

    A residual is measured less simulated, in standard deviations of the noise.
    """
    assert found.problem is not None
    assert found.linear is not None
    trial = found.problem.trials[number]
    seen = found.linear.shown[number].view.values
    count = sum(len(PARTS[channel.name]) for channel in trial.channels)
    figure, axes = subplots(15.0, 1.7 * count + 0.6, count, 3, font=11.0, sharex="col")
    begin, end = trial.contact - _CONTACT[0], trial.contact + _CONTACT[1]
    row = 0
    for channel, simulated in zip(trial.channels, seen, strict=True):
        step = max(1, channel.t.size // _MAX_POINTS)
        for k, part in enumerate(PARTS[channel.name]):
            values, contact, residuals = axes[row]
            measured, fitted = channel.values[:, k] * part.factor, simulated[:, k] * part.factor
            inside = (channel.t >= begin) & (channel.t <= end)
            for panel, chosen in ((values, slice(None, None, step)), (contact, inside)):
                t = channel.t[chosen]
                panel.plot(t, measured[chosen], ".", color=style.GREY, ms=2.5, rasterized=True)
                panel.plot(t, fitted[chosen], "-", color=style.BLUE, lw=1.2)
            off = np.clip(
                (channel.values[:, k] - simulated[:, k]) / channel.sigma[k], -_SHOWN, _SHOWN
            )
            residuals.plot(channel.t, off, ".", color=style.BLUE, ms=2.0, rasterized=True)
            if np.isfinite(begin):
                residuals.axvspan(begin, end, color=style.YELLOW, alpha=0.25, lw=0)
            residuals.set_ylim(-_SHOWN, _SHOWN)
            values.set_ylabel(f"{channel.name} {part.label}\n[{part.unit}]".strip())
            row += 1
    axes[0, 0].set_title(f"{Path(trial.name).name}: measured (grey), simulated (blue)", fontsize=12)
    axes[0, 1].set_title("the contact", fontsize=12)
    axes[0, 2].set_title("residuals, standard deviations; the contact shaded", fontsize=12)
    if np.isfinite(begin):
        axes[0, 1].set_xlim(begin, end)
    for each in axes[-1]:
        each.set_xlabel("time since the release that was assumed  [s]")
    return figure


def _draw_correlation(found: Calibration) -> Figure:
    """Return the figure of the correlations between the errors of the fitted parameters."""
    count = len(found.names)
    figure = new_figure(0.62 * count + 3.2, 0.55 * count + 2.2)
    axes = figure.add_subplot()
    dress(axes, None, 11.0)
    drawn = axes.imshow(found.correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    for i in range(count):
        for j in range(count):
            value = found.correlation[i, j]
            colour = "white" if abs(value) > 0.6 else style.BLACK
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", color=colour, fontsize=8.5)
            if i != j and abs(value) > INSEPARABLE:
                frame = Rectangle((j - 0.5, i - 0.5), 1.0, 1.0, fill=False, ec=style.ORANGE, lw=2.5)
                axes.add_patch(frame)
    axes.set_xticks(range(count), found.names, rotation=45, ha="right")
    axes.set_yticks(range(count), found.names)
    title = f"Correlation of the errors\nframed: beyond {INSEPARABLE:g}, hard to separate"
    axes.set_title(title, fontsize=12)
    figure.colorbar(drawn, ax=axes, shrink=0.8)
    return figure


def _draw_prediction(prediction: Prediction) -> Figure:
    """Return the figure of a predicted trial: each predicted series with its band of 95 %."""
    names = list(prediction.series)
    figure, axes = subplots(10.0, 3.0 * len(names), len(names), 1, font=12.0, sharex=True)
    for each, name in zip(axes.flat, names, strict=True):
        part = PARTS[name][0]
        low, middle, high = prediction.series[name] * part.factor
        each.fill_between(prediction.t, low, high, color=style.SKY, alpha=0.5, lw=0, label="95 %")
        each.plot(prediction.t, middle, "-", color=style.BLUE, lw=1.3, label="calibrated values")
        each.set_ylabel(f"{name}  [{part.unit}]")
        peaks = [int(middle.argmin()), int(middle.argmax())]
        each.plot(prediction.t[peaks], middle[peaks], "o", color=style.BLUE, ms=5)
    moved = [np.abs(prediction.series[name][1]) > 1e-5 for name in names if name in _BUFFER]
    if moved and np.any(moved):  # before the contact the buffer is at rest
        begin, end = float(prediction.t[np.any(moved, axis=0)][0]), float(prediction.t[-1])
        axes[0, 0].set_xlim(begin - 0.1 * (end - begin), end)
    placement = prediction.placement
    how = (
        "placed exactly"
        if placement is None
        else (f"placement {placement.position * 1e3:.3g} mm, {placement.angle * 1e3:.3g} mrad")
    )
    axes[0, 0].set_title(f"{prediction.scene.name}, predicted: {how}", fontsize=13)
    axes[0, 0].legend(fontsize=11)
    axes[-1, 0].set_xlabel("time since the release  [s]")
    return figure
