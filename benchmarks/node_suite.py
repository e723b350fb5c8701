"""The node suite as measured: pace, loss, latency, same bits, resets, killed nodes.

    .venv/bin/python benchmarks/node_suite.py            # all parts, about 20 minutes
    .venv/bin/python benchmarks/node_suite.py paced kills --kills 5

Starts the real nodes in processes of their own and writes docs/node_suite.md; parts that are
not run keep the figures of their last run (docs/node_suite.json).
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests" / "nodes"), str(Path(__file__).resolve().parent)]

from suite_trials import PARTS, settings  # noqa: E402

from benchmarks.machine import clock_rate, describe  # noqa: E402
from capture_sim.bench import compile_kernels  # noqa: E402

PAGE = ROOT / "docs" / "node_suite.md"
FIGURES = ROOT / "docs" / "node_suite.json"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], help="default: all")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the paced run (60)")
    parser.add_argument("--resets", type=int, default=3000, help="(3000)")
    parser.add_argument("--kills", type=int, default=30, help="(30)")
    parser.add_argument("--seed", type=int, default=1, help="of the random moments (1)")
    options = parser.parse_args()
    settings()
    compile_kernels()
    figures = json.loads(FIGURES.read_text()) if FIGURES.is_file() else {}
    for name in options.parts or PARTS:
        print(f"== {name}", flush=True)
        with tempfile.TemporaryDirectory(prefix="node_suite_") as folder:
            result = PARTS[name].run(Path(folder), options)
        machine = describe(clock_rate())
        figures[name] = {"machine": machine, **result}
        print(json.dumps(result, indent=1), flush=True)
        FIGURES.write_text(json.dumps(figures, indent=1) + "\n")
        PAGE.write_text(page(figures))
    return 0


def page(figures):
    """Return the page: a section for each part that has been measured."""
    lines = [
        "# The node suite as measured",
        "",
        "Made by `benchmarks/node_suite.py`; real nodes, each in a process of its own, over real",
        "DDS on loopback. Wall times are of the machine named with each part, as busy as it was.",
        "",
    ]
    for name, part in PARTS.items():
        if name in figures:
            result = figures[name]
            machine = result["machine"]
            lines += [f"## {part.TITLE}", "", *part.lines(result), ""]
            load = f", load average {result['load']:.1f}" if "load" in result else ""
            lines += [
                f"*{machine['date']}, {machine['cores']} cores {machine['processor']}, "
                f"{machine['clock under load']}, Python {machine['Python']}{load}.*",
                "",
            ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
