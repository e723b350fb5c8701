"""How exact the default run is over random benches, and how well a run knows its own error.

    python -m benchmarks.random_scenes                  # about 40 minutes
    python -m benchmarks.random_scenes narrow --scenes 100

writes the parts of docs/evidence/random_scenes.md.  The tests assert the same of the first 200
benches, and of some of the wider ones to 30 ms.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path

import numpy as np

from benchmarks.pages import table, write_parts

sys.path.append(str(Path(__file__).resolve().parent.parent / "tests"))

from random_accuracy import (
    AFTER,
    DEFAULT,
    RTOLS,
    TIGHT,
    against_itself,
    against_the_model,
    first_touch,
    residual_ratios,
)
from random_scenes import random_scenes, wide_scenes

from capture_sim.errors import SimulationError

#: m: below it a vehicle that creeps about the limit of rest decides, not the integrator.
FLOOR = 5e-8


def errors_table(errors: dict[str, list[np.ndarray]]) -> str:
    """Quantiles of errors (m), of each kind of run at each time."""
    rows = []
    for kind, found in errors.items():
        for after, values in zip(AFTER, np.transpose(found), strict=True):
            quantiles = [f"{x:.1e}" for x in np.quantile(values, (0.5, 0.9, 0.99, 1.0))]
            rows.append([kind, f"{after:g}", *quantiles, f"{np.mean(values < 1e-6):.1%}"])
    head = ["rtol", "s after the first touch", "median", "90 %", "99 %", "maximum"]
    return table([*head, "below 1e-6 m"], rows)


def narrow(asked: Namespace, _: Path) -> list[str]:
    """Benches near the paper's, each against itself at a tight tolerance."""
    scenes = random_scenes(asked.scenes)
    measured = [against_itself(scene) for scene in scenes]
    ratios = [x for scene in scenes if scene.supports is None for x in residual_ratios(scene)]
    wrong = [m for m in measured if m.wrong]
    # true error by estimate, wherever the two can be told from rounding's
    known = [
        m.error[-1] / m.estimate[-1]
        for m in measured
        if m.estimate[-1] > 1e-13 and (m.error[-1] > FLOOR or not m.on_floor)
    ]
    inside = np.mean([0.01 < ratio < 100.0 for ratio in ratios])
    return [
        f"{len(scenes)} scenes:",
        "",
        errors_table({f"{DEFAULT:g}": [m.error for m in measured]}),
        "",
        f"Touches in another order or number than at 1e-12: {len(wrong)}; not flagged by "
        f"`simulate(..., check=True)`: {sum(not m.flagged for m in wrong)}. Peak force, where "
        f"they are the same: within {max(m.peak for m in measured if not m.wrong):.1e} (relative).",
        "",
        f"True error at {AFTER[-1]:g} s divided by the check's estimate: median "
        f"{np.median(known):.2f}, 99 % {np.quantile(known, 0.99):.2f}, maximum {max(known):.1f} "
        f"({len(known)} scenes; scenes on supports below {FLOOR:g} m are left out).",
        "",
        "The energy residual as an estimate, error = 3 R_t |residual| / E_0, is within a factor of "
        f"100 in {inside:.1%} of {len(ratios)} runs at rtol "
        f"{', '.join(f'{rtol:g}' for rtol in RTOLS)} without supports.",
    ]


def whole(asked: Namespace, _: Path) -> list[str]:
    """Benches of all kinds, to 1 s, each against itself at a tight tolerance."""
    measured = []
    for scene in wide_scenes(asked.whole, seed=771001):
        try:
            if first_touch(scene) is not None:
                measured.append(against_itself(scene))
        except SimulationError:  # the tip leaves the range of the contact's law
            continue
    ratios = [m.error[-1] / m.estimate[-1] for m in measured if m.estimate[-1] > 1e-13]
    wrong = [m for m in measured if m.wrong]
    return [
        f"{len(measured)} scenes of {asked.whole} drawn; the others touch nothing within a second "
        "or stop:",
        "",
        errors_table({f"{DEFAULT:g}": [m.error for m in measured]}),
        "",
        f"Touches in another order or number than at 1e-12: {len(wrong)}. True error at "
        f"{AFTER[-1]:g} s divided by the check's estimate: median {np.median(ratios):.2f}, 99 % "
        f"{np.quantile(ratios, 0.99):.2f}, maximum {max(ratios):.2f}.",
    ]


def wide(asked: Namespace, _: Path) -> list[str]:
    """Benches of all kinds, against the independent model."""
    compared, count = [], asked.wide
    for number, scene in enumerate(wide_scenes(count), 1):
        compared += [found] if (found := against_the_model(scene)) is not None else []
        print(f"{number} of {count}", file=sys.stderr)
    default, tight = zip(*compared, strict=True)
    wrong = [m for m in default if m.wrong]
    return [
        f"{len(compared)} scenes of {count} drawn; the others touch nothing within a second or "
        "end where the model does:",
        "",
        errors_table(
            {
                f"{DEFAULT:g}": [m.error for m in default],
                f"{TIGHT:g}": [m.error for m in tight],
            }
        ),
        "",
        f"Touches in another order or number than the model's: {len(wrong)} at the default, "
        f"{sum(m.wrong for m in tight)} at {TIGHT:g}; of those at the default, not "
        f"flagged by `simulate(..., check=True)`: {sum(not m.flagged for m in wrong)}; flagged "
        f"without a reason: {sum(m.flagged and not m.wrong for m in default)}. Peak force at the "
        "default, where the touches are the same: within "
        f"{max(m.peak for m in default if not m.wrong):.1e} (relative).",
    ]


if __name__ == "__main__":
    write_parts(
        "random_scenes",
        __doc__,
        {"narrow": narrow, "whole": whole, "wide": wide},
        scenes=(1000, "scenes near the paper's"),
        whole=(300, "scenes of all kinds, against themselves"),
        wide=(300, "scenes of all kinds, against the model"),
    )
