"""How long a newcomer waits: clone, `make run` twice, in folders that hold nothing yet.

    python3 benchmarks/fresh_clone.py

Clones this repository's committed state into a temporary folder and runs `make run` there
twice, with empty caches of its own for pip, uv and compiled kernels, so that downloads and
compilation count. Prints both times and the verdicts.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def main():
    with tempfile.TemporaryDirectory(prefix="fresh_clone_") as name:
        folder = Path(name)
        clone = folder / "capture_sim"
        subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
        environment = dict(os.environ)
        environment.pop("CAPTURE_SIM_CACHE", None)
        environment["XDG_CACHE_HOME"] = str(folder / "cache")
        environment["UV_CACHE_DIR"] = str(folder / "cache" / "uv")
        environment["PIP_CACHE_DIR"] = str(folder / "cache" / "pip")
        for number in ("first", "second"):
            began = time.monotonic()
            done = subprocess.run(["make", "run"], cwd=clone, env=environment, check=False)
            print(f"{number} make run: {time.monotonic() - began:.1f} s, exit {done.returncode}")
            if done.returncode:
                return 1
        results = json.loads((clone / "runs" / "results.json").read_text(encoding="utf-8"))
        for row in results:
            print(f"{row['name']}: {row['verdict']} at {row['impact_speed']:.6f} m/s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
