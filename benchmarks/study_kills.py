"""Kills of studies at random moments: does --resume give the table of an undisturbed run?

    python -m benchmarks.study_kills --kills 50

A sweep and a design of a few hundred cheap runs are run undisturbed.  Then each is begun again and
again, killed (kill -9) at a random moment, and continued with --resume, which is killed in its turn
until one gets through.  What it writes must be byte for byte what the undisturbed one has written.
Every process is forked from one that has loaded everything, so that the kills fall into the runs
and the writing, and not into imports.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import tempfile
import time
from pathlib import Path

from capture_sim.cli import main as command
from capture_sim.dynamics.compilation import compile_kernels

SCENE = Path(__file__).resolve().parent.parent / "examples" / "servicer.yaml"
STUDIES = {
    "sweep": [
        *("sweep", "tilt_0", "--vary=buffer.c_A=uniform(5,30)", "--runs=400", "--workers=1"),
        *("--set=run.t_end=1", "--out=a.csv"),
    ],
    "design": [
        *("design", str(SCENE), "--minimize=max_buffer_force", "--stroke-limit=10"),
        *("--free=buffer.c_A=100:2000,buffer.k_A", "--set=run.rtol=1e-6", "--set=run.t_end=1"),
        *("--candidates=200", "--workers=1", "--out=a"),
    ],
}
#: What a study writes that must be the same, and its journal.
WRITTEN = {"sweep": ["a.csv"], "design": ["a/design.json", "a/design.yaml"]}
JOURNAL = {"sweep": "a.csv.journal", "design": "a/design.journal"}


def begin(arguments: list[str], folder: Path) -> int:
    """Fork a process that runs a command in a folder, without output; return its number."""
    child = os.fork()
    if child:
        return child
    os.chdir(folder)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    status = 70
    try:
        status = command(arguments)
    finally:
        os._exit(status)


def ended(child: int, seconds: float) -> int | None:
    """Wait for a process; return its exit status, or None after killing it."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def written(study: str, folder: Path) -> list[bytes]:
    """Return the files that must be the same."""
    return [(folder / name).read_bytes() for name in WRITTEN[study]]


def main() -> None:
    """Kill, continue, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    source = random.Random(asked.seed)
    compile_kernels()
    for study, arguments in STUDIES.items():
        with tempfile.TemporaryDirectory() as made:
            folder = Path(made)
            (folder / "whole").mkdir()
            for _ in range(2):  # the first one loads what a command imports when it is used
                began = time.monotonic()
                if command_status := ended(begin(arguments, folder / "whole"), 600.0):
                    raise SystemExit(f"{study}: status {command_status}")
                takes = time.monotonic() - began
            whole = written(study, folder / "whole")
            kills = same = n_studies = 0
            refused = 0
            while kills < asked.kills:
                n_studies += 1
                place = folder / str(n_studies)
                place.mkdir()
                for number in range(1000):
                    resume = ["--resume"] if (place / JOURNAL[study]).exists() else []
                    if (
                        number
                        and not resume
                        and all((place / name).exists() for name in WRITTEN[study])
                    ):
                        break  # killed after all was done
                    limit = source.uniform(0.0, takes) if kills < asked.kills else 600.0
                    status = ended(begin([*arguments, *resume], place), limit)
                    kills += status is None
                    if status == 0:
                        break
                    refused += status not in (None, 0)
                same += written(study, place) == whole
            print(
                f"{study}: {takes:.1f} s undisturbed; {kills} kills of {n_studies} studies, "
                f"{same} of them with the same files, {refused} starts refused",
                flush=True,
            )


if __name__ == "__main__":
    main()
