"""``capture-sim benchmark``."""

from __future__ import annotations

import argparse

from capture_sim import benchmarking

HELP = "measure speed against error on this machine"
DESCRIPTION = (
    "Measure speed against error on this machine, beside what else there is; "
    "write a page with diagrams."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    benchmarking.add_arguments(parser)


def run(options: argparse.Namespace) -> int:
    """Do it; return the exit status."""
    return benchmarking.run(options)
