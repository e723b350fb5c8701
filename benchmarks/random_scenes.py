"""How exact the default run is over random benches, and how well a run knows its own error.

    .venv/bin/python benchmarks/random_scenes.py [--scenes 1000] [--wide 300]

writes docs/random_scenes.md, or, with one of the two only, its part of it.  The tests assert the
same of the first 200 benches, and of some of the wider ones to 30 ms.
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
    TIGHT,
    Compared,
    Measured,
    compare,
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
            f"Made by `.venv/bin/python benchmarks/random_scenes.py --scenes {len(measured)}`: "
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


def errors_table(errors: dict[str, np.ndarray]) -> list[str]:
    """Quantiles of errors (n, times), a row for each kind and time."""
    shares = (0.5, 0.9, 0.99, 1.0)
    return [
        "| run | s after the first touch | median | 90 % | 99 % | largest | below 1e-6 m |",
        "|---|---|---|---|---|---|---|",
        *(
            f"| {kind} | {after:g} | "
            + " | ".join(f"{np.quantile(found[:, i], share):.1e}" for share in shares)
            + f" | {np.mean(found[:, i] < 1e-6):.1%} |"
            for kind, found in errors.items()
            for i, after in enumerate(AFTER)
        ),
    ]


def wide_part(compared: list[Compared], drawn: int) -> str:
    """Return the part on the wider benches as Markdown."""
    wrong = [c for c in compared if c.wrong]
    errors = {
        f"rtol {DEFAULT:g}, the default": np.array([c.default for c in compared]),
        f"rtol {TIGHT:g}": np.array([c.tight for c in compared]),
    }
    peak = max(c.peak for c in compared if not c.wrong)
    return "\n".join(
        [
            "## Wider benches against the independent model",
            "",
            f"Made by `.venv/bin/python benchmarks/random_scenes.py --wide {drawn}`: "
            f"{len(compared)} benches of {drawn} drawn, the others touch nothing within a second "
            "or end where the model does (tests/random_scenes.py: vehicles of 4 to 120 kg, both "
            "spinning, half-angles of 0.5 to 1.1 rad, every law of contact and of friction, "
            "restitutions from 0.2 to 1, mu up to 0.6; offset, attitudes, speed and buffer as "
            "above). The other side is tests/maximal_model.py: four bodies in twelve "
            "coordinates, stepped by SciPy's DOP853 at rtol 1e-12. Largest error so far of all "
            "coordinates, angles by their arm, m.",
            "",
            *errors_table(errors),
            "",
            "Touches in another order or number than the model's: "
            f"{len(wrong)} at the default, {sum(c.wrong_tight for c in compared)} at "
            f"{TIGHT:g}; of those at the default, not flagged by `simulate(..., check=True)`: "
            f"{sum(not c.flagged for c in wrong)}; flagged though right: "
            f"{sum(c.flagged and not c.wrong for c in compared)}. Largest force of the default, "
            f"where the touches are the same: within {peak:.1e}.",
            "",
        ]
    )


def compare_wide(count: int) -> list[Compared]:
    """Compare those of the wider benches that touch within their first second."""
    compared = []
    for number, scene in enumerate(wide_scenes(count)):
        found = compare(scene)
        print(f"{number + 1} of {count}", file=sys.stderr)
        if found is not None:
            compared.append(found)
    return compared


def write(first: str | None, second: str | None) -> None:
    """Write the page; a part that is None stays as it is."""
    path = ROOT / "docs" / "random_scenes.md"
    head, mark, tail = path.read_text(encoding="utf-8").partition("## Wider benches")
    parts = (head.rstrip() + "\n" if first is None else first, second or mark + tail)
    path.write_text("\n".join(parts), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int)
    parser.add_argument("--wide", type=int)
    arguments = parser.parse_args()
    both = arguments.scenes is None and arguments.wide is None
    first = second = None
    if both or arguments.scenes:
        scenes = random_scenes(arguments.scenes or 1000)
        measured = [measure(scene) for scene in scenes]
        free = [scene for scene in scenes if scene.supports is None]
        ratios = [ratio for scene in free for ratio in residual_ratios(scene)]
        first = page(measured, ratios)
    if both or arguments.wide:
        count = arguments.wide or 300
        second = wide_part(compare_wide(count), count)
    write(first, second)


if __name__ == "__main__":
    main()
