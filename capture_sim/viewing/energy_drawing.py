"""Where the energy of a run is and goes, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capture_sim.viewing import palette
from capture_sim.viewing.canvas import FONT, SMALL, new_figure, set_fonts
from capture_sim.viewing.series import Shown, as_shown, finish_time_axis
from capture_sim.viewing.source import ViewableRun, time_window

#: Name, colour and fields of a sample of each layer, from below.
LAYERS = (
    ("kinetic", palette.SKY, ("kinetic",)),
    ("elastic, buffer", palette.BLUE, ("elastic_axial", "elastic_torsion", "elastic_stop")),
    ("elastic, contact and latch", palette.DARK, ("elastic_contact", "elastic_latch")),
    ("axial damper", palette.ORANGE, ("dissipated_axial",)),
    ("torsional damper", palette.DARK_GREEN, ("dissipated_torsion",)),
    ("contact hysteresis", palette.VERMILION, ("dissipated_contact",)),
    ("friction of the tip", palette.PURPLE, ("dissipated_friction",)),
    ("rolling", palette.LIGHT, ("dissipated_rolling",)),
    ("latches", palette.GREEN, ("dissipated_latch",)),
    ("stops", palette.BLACK, ("dissipated_stop",)),
    ("landing of the mass", palette.YELLOW, ("dissipated_landing",)),
)
_VISIBLE = 1e-3  # share of the whole below which a layer is left out
_MJ = 1e3
_POINTS = 600


def has_ledger(run: ViewableRun) -> bool:
    """Tell whether the run's energies are known; those of a measured run are not."""
    return bool(np.isfinite(run.samples["kinetic"]).any())


def energy(
    runs: ViewableRun | Sequence[ViewableRun], *, labels: Sequence[str] | None = None
) -> Figure:
    """Draw what the energy put in has become, layer on layer, a panel for each run.

    The layers' sum is drawn against what was put in (dashed): both lie on each other when the
    ledger closes.
    """
    shown = as_shown(runs, labels)
    figure = new_figure(5.6 * len(shown) + 1.0, 6.2)
    row = figure.subplots(1, len(shown), squeeze=False, sharey=True)[0]
    for axes, one in zip(row, shown, strict=True):
        _draw(axes, one)
        axes.set_title(one.label, fontsize=FONT, fontweight="bold")
    row[0].set_ylabel("energy  [mJ]")
    # each layer once, whichever run has it
    named: dict[str, Artist] = {}
    for axes in row:
        handles, names = axes.get_legend_handles_labels()
        named.update(zip(names, handles, strict=True))
    figure.legend(
        handles=list(named.values()),
        labels=list(named),
        loc="outside lower center",
        ncols=3,
        fontsize=SMALL,
    )
    set_fonts(row)
    return figure


def _draw(axes: Axes, one: Shown) -> None:
    samples, end = one.run.samples, time_window(one.run)[1]
    shown = samples[samples["t"] <= end]
    shown = shown[:: max(len(shown) // _POINTS, 1)]  # areas are not simplified when saved
    t = shown["t"]
    put_in = (shown["kinetic"][0] + shown["work_string"]) * _MJ
    below = np.zeros(len(t))
    for name, colour, fields in LAYERS:
        layer = np.sum([shown[field] for field in fields], axis=0) * _MJ
        if layer.max(initial=0.0) > _VISIBLE * put_in.max():
            axes.fill_between(t, below, below + layer, color=colour, lw=0, label=name)
        below = below + layer
    axes.plot(t, put_in, color=palette.BLACK, lw=1.8, ls=(0, (4, 3)), label="put in")
    axes.set_ylim(0.0, 1.08 * put_in.max())
    finish_time_axis(axes, [one], (float(t[0]), float(t[-1])))
