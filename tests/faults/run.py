"""Makes each fault of faults.toml in a copy of the repository, and reports those no test detects.

    make faults                                     all, one job a core
    python tests/faults/run.py paced_backwards      only these
    python tests/faults/run.py --jobs 16 --for 540  begin none after 540 s; a second call goes on
    python tests/faults/run.py --tree build/before  the faults and tests of another checkout
    python tests/faults/run.py --cases all          by the tests of make test-all, not make test

Every job has its own copy and its own compiled kernels, in build/faults, which a second call uses
again.  The tests run without a fault first: only a test that passed then can detect one.  Results
are kept as long as neither sources nor tests change.  What this machine lacks (ROS, say) is named.
The exit status is 1 if a fault was not detected, and 2 if one could not be tried.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
FAULTS = Path("tests", "faults", "faults.toml")
LEFT_OUT = (".*", "build", "install", "log", "runs", "__pycache__", "*.egg-info")
#: Longest time of a fault's tests, s: what makes a loop endless is detected then.
PATIENCE = 500.0
DETECTED, MISSED, NOT_TRIED = "detected", "MISSED", "not tried"


def digest(tree: Path) -> str:
    """Return a hash of all that decides about the results, and of this machine's Python."""
    found = hashlib.sha256(sys.version.encode())
    for folder in ("benchmarks", "capture_sim", "config", "docs", "examples", "tests", "tools"):
        for path in sorted((tree / folder).rglob("*")):
            if path.is_file() and path.suffix != ".pyc":
                found.update(str(path.relative_to(tree)).encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:16]


class Copy:
    """A copy of the tree, with compiled kernels of its own."""

    def __init__(self, tree: Path, folder: Path, changed: set[str], cases: str) -> None:
        self._folder, self._tree, self._cases = folder, folder / "tree", cases
        if not self._tree.exists():
            # the files' times as well, by which Numba knows its compiled code
            shutil.copytree(tree, self._tree, ignore=shutil.ignore_patterns(*LEFT_OUT))
        for name in changed:  # a call that was killed leaves its fault
            if (self._tree / name).read_bytes() != (tree / name).read_bytes():
                shutil.copy2(tree / name, self._tree / name)

    def tests(self, tests: list[str], only: list[str] | None = None) -> dict[str, list[str]]:
        """Run tests, with `only` these cases and up to the first failure; return the outcomes."""
        outcomes, cases = self._folder / "outcomes.json", self._folder / "only.json"
        outcomes.unlink(missing_ok=True)
        cases.write_text(json.dumps(only), encoding="utf-8")
        environment = {
            **os.environ,
            **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
            "CAPTURE_SIM_CACHE": str(self._folder / "cache"),
            "CAPTURE_SIM_CASES": self._cases,
            "FAULTS_ONLY": str(cases) if only else "",
            "FAULTS_OUTCOMES": str(outcomes),
            "PYTHONPATH": f"{self._tree}{os.pathsep}{HERE}",
        }
        # without pyproject's options, some of which need plugins
        command = [sys.executable, "-m", "pytest", "-q", "-o", "addopts=", "-p", "no:cacheprovider"]
        command += ["-p", "outcomes", *(["-x"] if only else []), *tests]
        with subprocess.Popen(
            command,
            cwd=self._tree,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        ) as process:
            try:
                output, _ = process.communicate(timeout=PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                return {"passed": [], "failed": ["the tests did not end"], "not run": []}
        if outcomes.exists():
            return json.loads(outcomes.read_text(encoding="utf-8"))
        last = (output.strip().splitlines() or ["no output"])[-1]
        return {"passed": [], "failed": [], "not run": [last]}

    def with_fault(self, fault: dict, passed: list[str]) -> tuple[str, str]:
        """Return whether a case that `passed` without the fault fails with it, and which."""
        if not passed:
            return NOT_TRIED, "none of its tests passes here"
        path = self._tree / fault["file"]
        right, times = path.read_text(encoding="utf-8"), path.stat()
        if right.count(fault["text"]) != 1:
            return NOT_TRIED, f"its text is not in {fault['file']} once"
        try:
            path.write_text(right.replace(fault["text"], fault["fault"]), encoding="utf-8")
            found = self.tests(fault["tests"], passed)
        finally:
            path.write_text(right, encoding="utf-8")
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
        if found["failed"]:
            return DETECTED, found["failed"][0]
        if not found["passed"]:
            return DETECTED, "the tests do not load: " + " ".join(found["not run"][:1])
        return MISSED, f"{len(found['passed'])} tests pass"


class Results:
    """What was found so far about one state of a tree: a line for each entry."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self._found = dict(map(json.loads, lines))

    def get(self, key: str) -> dict | None:
        """Return the entry of a key, None if there is none yet."""
        return self._found.get(key)

    def put(self, key: str, entry: dict) -> None:
        """Keep an entry."""
        self._found[key] = entry
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([key, entry]) + "\n")


def main() -> int:
    """Try the faults named on the command line, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--for", type=float, default=float("inf"), dest="limit", metavar="SECONDS")
    parser.add_argument("--tree", type=Path, default=ROOT)
    parser.add_argument("--cases", choices=("few", "all"), default="few", help="see tests/cases.py")
    options = parser.parse_args()
    tree, end = options.tree.resolve(), time.monotonic() + options.limit
    faults = tomllib.loads((tree / FAULTS).read_text(encoding="utf-8"))
    if unknown := set(options.names) - set(faults):
        parser.error(f"unknown: {', '.join(sorted(unknown))}")
    names = options.names or list(faults)
    work = ROOT / "build" / "faults" / digest(tree)
    results = Results(work / f"results_{options.cases}.jsonl")
    copies: queue.SimpleQueue[Copy] = queue.SimpleQueue()

    def each(kind: str, keys: list[str], job: Callable[[Copy, str], dict]) -> None:
        def attempt(key: str) -> None:
            if results.get(f"{kind} {key}") or time.monotonic() > end:
                return
            copy = copies.get()
            begun = time.monotonic()
            try:
                entry = job(copy, key)
            finally:
                copies.put(copy)
            entry["seconds"] = round(time.monotonic() - begun, 1)
            results.put(f"{kind} {key}", entry)
            print(f"{kind} {key}: {entry['result']}, {entry['seconds']} s", flush=True)

        with ThreadPoolExecutor(options.jobs) as pool:
            list(pool.map(attempt, keys))

    def baseline(copy: Copy, test: str) -> dict:
        found = copy.tests([test])
        bad = [*found["failed"], *found["not run"]]
        return {"result": f"{len(found['passed'])} pass, {len(bad)} do not", **found}

    def attempt(copy: Copy, name: str) -> dict:
        without = [results.get(f"tests {test}") or {} for test in faults[name]["tests"]]
        passed = [case for found in without for case in found.get("passed", ())]
        result, by = copy.with_fault(faults[name], passed)
        if not passed:
            why = [line for found in without for line in (*found["failed"], *found["not run"])]
            by = why[0] if why else by
        return {"result": result, "by": by}

    for job in range(options.jobs):
        changed = {fault["file"] for fault in faults.values()}
        copies.put(Copy(tree, work / str(job), changed, options.cases))
    tests = dict.fromkeys(test for name in names for test in faults[name]["tests"])
    each("tests", list(tests), baseline)
    ready = [n for n in names if all(results.get(f"tests {t}") for t in faults[n]["tests"])]
    # those that compile again last longest
    each("fault", sorted(ready, key=lambda n: not compiles(faults[n]["file"])), attempt)

    found = {name: results.get(f"fault {name}") or {} for name in names}
    print("\n| fault | file | result | by | s |\n|---|---|---|---|---|")
    for name, entry in found.items():
        cells = [faults[name]["file"], entry.get("result", "not yet"), entry.get("by", "")]
        print(f"| {name} | {' | '.join(cells)} | {entry.get('seconds', '')} |")
    counts = [e.get("result", "not yet") for e in found.values()]
    print(", ".join(f"{counts.count(kind)} {kind}" for kind in dict.fromkeys(counts)))
    return 1 if MISSED in counts else 0 if set(counts) == {DETECTED} else 2


def compiles(file: str) -> bool:
    """Return True if a file is a source of the kernels, as far as its folder shows."""
    kernels = ("dynamics/engine/", "dynamics/model/", "dynamics/solver/", "detection/criteria")
    return any(f"capture_sim/{name}" in file for name in kernels)


if __name__ == "__main__":
    raise SystemExit(main())
