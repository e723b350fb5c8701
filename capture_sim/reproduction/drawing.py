"""The figures of the page, by name: which runs each is made of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from capture_sim.reproduction.cases import DOCKING
from capture_sim.reproduction.second_engine import Comparison
from capture_sim.simulation import Result


@dataclass(frozen=True)
class Picture:
    """A figure: its file's name, its title on the page, and how it is drawn from the runs."""

    name: str
    title: str
    cases: tuple[str, ...]
    draw: Callable[[Mapping[str, Result]], Any]


def _figure_5(runs: Mapping[str, Result]) -> Any:
    from capture_sim.viewing import figures

    return figures.impact_force(
        [runs["paper_clamped"], runs["paper_undamped"]],
        labels=["probe clamped", "buffer, no damper"],
        window=(0.0, 0.3),
    )


def _figure_6(runs: Mapping[str, Result]) -> Any:
    from capture_sim.viewing import figures
    from capture_sim.viewing.resolving import resolved

    return figures.undamped_results(resolved(runs["paper_undamped"]))


def _figure_7(runs: Mapping[str, Result]) -> Any:
    from capture_sim.viewing import figures

    return figures.trajectory(runs["paper_undamped"])


def _figure_8(runs: Mapping[str, Result]) -> Any:
    from capture_sim.viewing import figures

    return figures.buffer_results(runs["paper_designed"])


def _figure_8c(runs: Mapping[str, Result]) -> Any:
    from capture_sim.viewing import figures

    return figures.trajectory(runs["paper_designed"])


def _figure_12(runs: Mapping[str, Result]) -> Any:
    from capture_sim.viewing.snapshots import snapshots

    return snapshots(runs[DOCKING])


def _figure_13(runs: Mapping[str, Result]) -> Any:
    from capture_sim.viewing import figures

    return figures.trajectories([runs[f"paper_case_{n}"] for n in (1, 2, 3)])


def _figure_15(runs: Mapping[str, Result]) -> Any:
    from capture_sim.viewing.snapshots import snapshots

    return snapshots([runs["tilt_0"], runs["tilt_p10"], runs["tilt_m10"]], count=5)


PICTURES = (
    Picture(
        "figure_5",
        "Figure 5: impact force, probe clamped and on the buffer",
        ("paper_clamped", "paper_undamped"),
        _figure_5,
    ),
    Picture("figure_6", "Figure 6: the buffer without damper", ("paper_undamped",), _figure_6),
    Picture(
        "figure_7", "Figure 7: the tip in the cone, without damper", ("paper_undamped",), _figure_7
    ),
    Picture("figure_8", "Figure 8, a and b: the designed buffer", ("paper_designed",), _figure_8),
    Picture(
        "figure_8c",
        "Figure 8, c: the tip in the cone, designed buffer",
        ("paper_designed",),
        _figure_8c,
    ),
    Picture("figure_12", "Figure 12: docking from one metre away", (DOCKING,), _figure_12),
    Picture(
        "figure_13",
        "Figure 13: cases 1 to 3",
        ("paper_case_1", "paper_case_2", "paper_case_3"),
        _figure_13,
    ),
    Picture(
        "figure_15",
        "Figures 15 to 17: the experiments at 0, +10 and -10 degrees",
        ("tilt_0", "tilt_p10", "tilt_m10"),
        _figure_15,
    ),
)

#: Figures that need more than the cases' runs.
ENGINE_PICTURES = {
    "figure_10": "Figure 10: velocities, beside a second engine",
    "figure_11": "Figure 11: the buffer, beside a second engine",
}
READINGS_PICTURE = ("readings", "Verdicts over what the paper leaves open")


def draw_engines(comparison: Comparison) -> dict[str, Any]:
    """Return Figures 10 and 11 with the second engine's curves in them."""
    from capture_sim.viewing import figures
    from capture_sim.viewing.series import Trace

    rates = Trace("Exudyn", comparison.t, comparison.v)
    rest = comparison.ours.scene.rest_length
    stroke = Trace("Exudyn", comparison.t, comparison.q[:, 4] - rest)
    return {
        "figure_10": figures.velocities(
            comparison.ours, labels=["capture_sim"], window=(0.0, 0.3), traces=[rates]
        ),
        "figure_11": figures.axial_performance(
            comparison.ours, labels=["capture_sim"], traces=[stroke]
        ),
    }


def save_picture(figure: Any, folder: Path, name: str) -> Path:
    """Save a figure as PNG.

    Raises
    ------
    RecordingError
        The file cannot be written.
    """
    from capture_sim.viewing.canvas import save

    return save(figure, folder / f"{name}.png")
