"""Runs the style check, the core tests and the node tests side by side; run by `make test`.

The core tests print as they run.  The node tests, which mostly wait, report how far they are; their
output and that of the style check follow.  The last line has what passed and failed, minutes, and
the seconds of a loop of 10 million additions, by which machines can be compared.
"""

from __future__ import annotations

import os
import re
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path

BUILD = Path("build")
#: Time between two lines on the node tests, s.
PERIOD = 30.0
#: Part of `make test`, and its rule in the Makefile.
RULES = {"style": "lint", "nodes": "test-nodes"}


def loop_seconds() -> float:
    """Return the CPU time of a loop of 10 million additions, s."""
    begin, total = time.process_time(), 0
    for i in range(10_000_000):
        total += i
    return time.process_time() - begin


def started(name: str, rule: str) -> subprocess.Popen[bytes]:
    """Start a rule of the Makefile, whose output goes to a file."""
    with (BUILD / f"{name}.log").open("wb") as log:
        command = ["make", "--no-print-directory", rule]
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)


def progress_of(log: Path) -> str:
    """Return the last percentage that pytest has printed."""
    found = re.findall(r"\[ *(\d+)%\]", log.read_text(encoding="utf-8", errors="replace"))
    return f"{found[-1]} %" if found else "starting"


def counts_in(text: str) -> dict[str, int]:
    """Return the numbers of pytest's last line by word, e.g. passed."""
    lines = re.findall(r"=+ (.*\d (?:passed|failed|error).*) in [\d.]+s.*=+", text)
    return {
        word.rstrip("s"): int(number)
        for number, word in re.findall(r"(\d+) (\w+)", lines[-1] if lines else "")
    }


def main() -> int:
    """Run all; return the exit status."""
    BUILD.mkdir(exist_ok=True)
    loop, begin = loop_seconds(), time.monotonic()
    others = {name: started(name, rule) for name, rule in RULES.items()}
    over = threading.Event()

    def report() -> None:
        while not over.wait(PERIOD):
            if others["nodes"].poll() is None:
                print(f"\n[node tests: {progress_of(BUILD / 'nodes.log')}]", flush=True)

    threading.Thread(target=report, daemon=True).start()
    command = ["make", "--no-print-directory", "test-core"]
    core = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert core.stdout is not None
    text = b""
    while part := core.stdout.read1(65536):
        text += part
        sys.stdout.buffer.write(part)
        sys.stdout.flush()
    statuses = {"core": core.wait()} | {name: each.wait() for name, each in others.items()}
    over.set()
    logs = {name: (BUILD / f"{name}.log").read_text(errors="replace") for name in RULES}
    for name, log in logs.items():
        print(f"\n--- {name} ---\n{log}", end="")
    counts = [counts_in(text.decode(errors="replace")), counts_in(logs["nodes"])]
    totals = {word: sum(each.get(word, 0) for each in counts) for word in ("passed", "failed")}
    errors = sum(each.get("error", 0) for each in counts)
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    failed = [name for name, status in statuses.items() if status]
    print(
        f"\n{totals['passed']} tests passed, {totals['failed'] + errors} failed"
        f"{'; not in order: ' + ', '.join(failed) if failed else '; style in order'}; "
        f"{(time.monotonic() - begin) / 60.0:.1f} min, "
        f"{(usage.ru_utime + usage.ru_stime) / 60.0:.1f} CPU min on {os.cpu_count()} cores; "
        f"10 million additions take {loop:.2f} s",
        flush=True,
    )
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
