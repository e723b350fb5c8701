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


def note_files(path, begin):
    """Write the package's files to ``path`` as they are entered, from a call of ``begin`` on.

    Each file has one line, at its first call by any thread; ``begin`` is the name of a function.
    """
    seen, has_begun, file = set(), False, os.open(path, os.O_CREAT | os.O_WRONLY)

    def note(frame, *_):
        nonlocal has_begun
        name = frame.f_code.co_filename
        has_begun = has_begun or frame.f_code.co_name == begin
        if has_begun and name not in seen and name.startswith(PACKAGE):
            seen.add(name)
            os.write(file, f"{name.removeprefix(PACKAGE)}\n".encode())

    # it returns nothing: the lines of a function are not traced, which costs less than a profile
    threading.settrace(note)
    sys.settrace(note)


def way(title):
    """Return the steps of a way in CONTRIBUTING, each as the files that it names."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    _, _, text = text.partition(f"### {title}\n")
    steps = re.findall(r"^\d+\. ((?:.+\n)(?:   .+\n)*)", text.partition("\n#")[0], re.MULTILINE)
    return [files for step in steps if (files := re.findall(r"`([a-z_/]+\.py)`", step))]


def check_order(steps, entered):
    """All files of the steps were entered, and no step before the one that precedes it."""
    firsts = [[entered.index(file) for file in files] for files in steps]
    begins = [min(first) for first in firsts]
    assert begins == sorted(begins), list(zip(steps, begins, strict=True))
