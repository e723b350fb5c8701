"""Which files of the package are entered, in which order, and the ways that CONTRIBUTING names."""

from __future__ import annotations

import os
import re
import sys
import threading
from pathlib import Path

import capture_sim

ROOT = Path(__file__).parents[1]
PACKAGE = str(Path(capture_sim.__file__).parent) + os.sep


def tracer(add):
    """Return a trace function that calls ``add`` with each of the package's files, once."""
    seen = set()

    def note(frame, *_):
        name = frame.f_code.co_filename
        if name not in seen and name.startswith(PACKAGE):
            seen.add(name)
            add(name.removeprefix(PACKAGE))

    return note  # it returns nothing: the lines of a function are not traced, which costs more


def note_files(path):
    """Write the files to ``path``, a line each, as any thread of this process enters them."""
    file = os.open(path, os.O_CREAT | os.O_WRONLY)
    note = tracer(lambda name: os.write(file, f"{name}\n".encode()))
    threading.settrace(note)
    sys.settrace(note)


def files_entered(work):
    """Return the files that a call of ``work`` enters, in their order."""
    found = []
    before = sys.gettrace()
    sys.settrace(tracer(found.append))
    try:
        work()
    finally:
        sys.settrace(before)
    return found


def way(title):
    """Return the steps of a way in CONTRIBUTING, each as the files that it names."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    _, _, text = text.partition(f"### {title}\n")
    steps = re.findall(r"^\d+\. ((?:.+\n)(?:   .+\n)*)", text.partition("\n#")[0], re.MULTILINE)
    return [files for step in steps if (files := re.findall(r"`([a-z_/]+\.py)`", step))]


def check_order(steps, entered):
    """Each file of the steps was entered, and no step before the one that precedes it."""
    begins = [min(entered.index(file) for file in files) for files in steps]
    assert begins == sorted(begins), list(zip(steps, begins, strict=True))
