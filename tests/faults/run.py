"""Makes each fault of faults.toml in a copy of the repository, and says which no test caught.

    make faults                                   all, about an hour of one core
    python tests/faults/run.py paced_backwards    these alone

The exit status is 1 when a fault was not caught.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FAULTS = tomllib.loads((Path(__file__).parent / "faults.toml").read_text(encoding="utf-8"))


def copy_to(folder: Path) -> None:
    """Copy what git knows of."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, stdout=subprocess.PIPE, check=True)
    for name in filter(None, listed.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)


def fails(folder: Path, tests: list[str]) -> bool:
    """Run tests of a copy; return whether one failed, and not merely could not be run."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "CAPTURE_SIM_CACHE": f"{folder}-cache"}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(command)}: status {done.returncode}\n{done.stdout[-2000:]}")
    return done.returncode == 1


def main() -> int:
    """Try the faults named on the command line, or all."""
    missed = []
    with tempfile.TemporaryDirectory(prefix="capture_sim_faults_") as name:
        folder = Path(name, "copy")
        copy_to(folder)
        for title in sys.argv[1:] or FAULTS:
            fault = FAULTS[title]
            path = folder / fault["file"]
            right = path.read_text(encoding="utf-8")
            assert right.count(fault["text"]) == 1, f"{title}: its text is not in {path} once"
            path.write_text(right.replace(fault["text"], fault["fault"]), encoding="utf-8")
            caught = fails(folder, fault["tests"])
            path.write_text(right, encoding="utf-8")
            print(f"{'caught' if caught else 'MISSED'}  {title}", flush=True)
            if not caught:
                missed.append(title)
    print(f"{len(missed)} of {len(sys.argv[1:] or FAULTS)} faults were not caught")
    return 1 if missed else 0


if __name__ == "__main__":
    raise SystemExit(main())
