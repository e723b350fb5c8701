"""How exact the default run is over random benches, and how well a run knows its own error.

    .venv/bin/python benchmarks/random_scenes.py [--scenes 1000]

writes docs/random_scenes.md.  The tests assert the same of the first 200 benches.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from random_accuracy import (  # noqa: E402
    AFTER,
    DEFAULT,
    RTOLS,
    Measured,
    measure,
    residual_ratios,
)
from random_scenes import random_scenes, wide_scenes  # noqa: E402

#: m: below it a vehicle that creeps about the limit of rest decides, not the integrator.
FLOOR = 5e-8


def quantiles(values: np.ndarray) -> str:
    """Median, 99 % and largest, as cells of a table."""
    return " | ".join(f"{np.quantile(values, q):.1e}" for q in (0.5, 0.99, 1.0))


def trust(measured: list[Measured]) -> np.ndarray:
    """True error by estimate at the end, wherever the two can be told from rounding's."""
    return np.array(
        [
            m.error[-1] / m.estimate[-1]
            for m in measured
            if m.estimate[-1] > 1e-13 and (m.error[-1] > FLOOR or not m.on_floor)
        ]
    )


def error_table(measured: list[Measured]) -> list[str]:
    """Return the table of errors, line by line."""
    errors = np.array([m.error for m in measured])
    return [
        "| s after the first touch | median | 99 % | largest | below 1e-6 m |",
        "|---|---|---|---|---|",
        *(
            f"| {after:g} | {quantiles(errors[:, i])} | {np.mean(errors[:, i] < 1e-6):.1%} |"
            for i, after in enumerate(AFTER)
        ),
    ]


def page(measured: list[Measured], ratios: list[float]) -> str:
    """Return the page as Markdown."""
    wrong = [m for m in measured if m.wrong]
    known = trust(measured)
    inside = np.mean([0.01 < ratio < 100.0 for ratio in ratios])
    return "\n".join(
        [
            "# The default tolerance over random benches",
            "",
            "Made by `.venv/bin/python benchmarks/random_scenes.py`: "
            f"{len(measured)} benches (tests/random_scenes.py: offset, attitudes, speed, springs "
            "and damper drawn at random, every fourth on supports), each at the default "
            f"rtol {DEFAULT:g} and at 1e-12. Errors in m, the largest of all coordinates, angles "
            "by their arm.",
            "",
            *error_table(measured),
            "",
            f"Touches in another order or number than at 1e-12: {len(wrong)}; not flagged by "
            "`simulate(..., check=True)`: "
            f"{sum(not m.flagged for m in wrong)}. Largest force, where they are the same: within "
            f"{max(m.peak for m in measured if not m.wrong):.1e}.",
            "",
            f"True error at {AFTER[-1]:g} s by the check's estimate: median "
            f"{np.median(known):.2f}, 99 % {np.quantile(known, 0.99):.2f}, largest "
            f"{known.max():.1f} ({len(known)} benches; left out are those on supports below "
            f"{FLOOR:g} m, where a vehicle at the limit of rest decides).",
            "",
            "Energy residual as a coarser estimate, error = 3 R_t |residual| / E_0: within a "
            f"factor of 100 in {inside:.1%} of {len(ratios)} runs at rtol "
            + ", ".join(f"{rtol:g}" for rtol in RTOLS)
            + " without supports.",
            "",
        ]
    )


def wide_page(measured: list[Measured], scenes: int) -> str:
    """Return the page of the wider benches as Markdown."""
    wrong = [m for m in measured if m.wrong]
    return "\n".join(
        [
            "# The default tolerance over wider random benches",
            "",
            "Made by `.venv/bin/python benchmarks/random_scenes.py --wide`: "
            f"{len(measured)} benches of {scenes} drawn, the others never touch "
            "(tests/random_scenes.py: vehicles of 4 to 120 kg that spin, half-angles of 0.5 to "
            "1.1 rad, every law of contact and friction, offset, attitudes, speed and buffer as in "
            f"random_scenes.md), each at the default rtol {DEFAULT:g} and at 1e-12. Errors in m.",
            "",
            *error_table(measured),
            "",
            "Without those whose touches come in another order or number than at 1e-12 "
            f"({len(wrong)}; not flagged by `simulate(..., check=True)`: "
            f"{sum(not m.flagged for m in wrong)}) the largest is "
            f"{max(m.error[-1] for m in measured if not m.wrong):.1e} m at {AFTER[-1]:g} s.",
            "",
        ]
    )


def measure_wide(count: int) -> list[Measured]:
    """Measure those of the wider benches that touch within their first second."""
    measured = []
    for scene in wide_scenes(count):
        try:
            measured.append(measure(scene))
        except StopIteration:
            continue
    return measured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--wide", action="store_true", help="docs/random_scenes_wide.md instead")
    arguments = parser.parse_args()
    if arguments.wide:
        name = "random_scenes_wide.md"
        text = wide_page(measure_wide(arguments.scenes), arguments.scenes)
    else:
        name = "random_scenes.md"
        scenes = random_scenes(arguments.scenes)
        measured = [measure(scene) for scene in scenes]
        free = [scene for scene in scenes if scene.supports is None]
        ratios = [ratio for scene in free for ratio in residual_ratios(scene)]
        text = page(measured, ratios)
    (ROOT / "docs" / name).write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
