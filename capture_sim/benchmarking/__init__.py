"""Speed against error, measured on the machine at hand."""

from __future__ import annotations

import argparse
from pathlib import Path

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``capture-sim benchmark``."""
    parser.add_argument(
        "--quick", action="store_true", help="a reduced sweep, done in less than a minute"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("docs"),
        help="folder of the page and its pictures (default: docs)",
    )


def run(options: argparse.Namespace) -> int:
    """Run the benchmark; return the exit status."""
    from capture_sim.benchmarking.command import run as run_benchmark

    return run_benchmark(options)
