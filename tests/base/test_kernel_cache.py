"""Compiled kernels on disk: what a second process loads."""

import importlib
import itertools
import subprocess
import sys

import fresh_python
import pytest

from capture_sim.base.compiled.kernels import code_hash
from capture_sim.detection.exact import follow
from capture_sim.dynamics.engine.loop import advance

MODULE = """
from capture_sim.base.compiled.kernels import entry_kernel, kernel


@kernel
def half(x):
    return 0.5 * x


@entry_kernel
def quarter(x):
    return half(half(x))


@entry_kernel
def eighth(x):
    return half(quarter(x))
"""

#: A kernel that Python calls, one in another file, and its constants in a third one.
FILES = {
    "entry_of_mine": """
from capture_sim.base.compiled.kernels import entry_kernel
from called_by_mine import a_quarter


@entry_kernel
def quarter(x):
    return a_quarter(x)
""",
    "called_by_mine": """
from capture_sim.base.compiled.kernels import inline_kernel, kernel
from numbers_of_mine import FACTORS, SHARE, Count


@inline_kernel
def one_half(x):
    \"\"\"Half.\"\"\"
    return 0.5 * x


@kernel
def a_quarter(x):
    return one_half(x) * SHARE * FACTORS[0] * (Count.TWICE / 2)
""",
    "numbers_of_mine": """
from enum import IntEnum

import numpy as np

SHARE = 0.5
FACTORS = np.array([1.0])


class Count(IntEnum):
    TWICE = 2
""",
}


def write(folder, old="", new=""):
    for name, text in FILES.items():
        (folder / f"{name}.py").write_text(text.replace(old, new) if old else text)


def python(folder, code):
    return fresh_python.python(code, folder, CAPTURE_SIM_CACHE=str(folder))


def test_a_kernel_that_was_loaded_runs_and_is_compiled_into_another(tmp_path):
    """Its text is kept apart, and read only where another kernel needs it, as an FMU does."""
    (tmp_path / "mine.py").write_text(MODULE)
    for _ in range(2):
        found = python(tmp_path, "import mine; print(mine.quarter(8.0))")
        assert found.stdout == "2.0\n", found.stderr
    (text,) = tmp_path.rglob("*.bc")
    found = python(tmp_path, "import mine; mine.quarter(8.0); print(mine.eighth(8.0))")
    assert found.stdout == "1.0\n", found.stderr
    for kept in tmp_path.rglob("mine.eighth*"):
        kept.unlink()
    text.unlink()
    found = python(tmp_path, "import mine; mine.quarter(8.0); print(mine.eighth(8.0))")
    assert found.stdout == "1.0\n", found.stderr  # compiled again


def test_a_change_in_another_file_is_compiled(tmp_path):
    """No list names the files of kernels: the caller leads to each."""
    code = "from entry_of_mine import quarter; print(quarter(4.0))"
    write(tmp_path)
    assert python(tmp_path, code).stdout == "1.0\n"
    write(tmp_path, "0.5 * x", "0.25 * x")
    assert python(tmp_path, code).stdout == "0.5\n"


@pytest.mark.parametrize(
    "old, new",
    [
        ("one_half(x) * SHARE", "one_half(x)"),
        ("0.5 * x", "0.25 * x"),
        ("SHARE = 0.5", "SHARE = 0.75"),
        ("TWICE = 2", "TWICE = 8"),
        ("[1.0]", "[3.0]"),
        ("@inline_kernel", "@kernel"),
    ],
)
def test_the_hash_of_a_kernel_follows_all_that_it_reads(tmp_path, monkeypatch, old, new):
    def entry():
        for name in FILES:
            sys.modules.pop(name, None)
        return code_hash(importlib.import_module("entry_of_mine").quarter)

    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    write(tmp_path)
    first = entry()
    write(tmp_path, '"""Half."""', '"""The half."""')
    assert entry() == first  # a remark is no code
    write(tmp_path, old, new)
    assert entry() != first


def test_the_hash_of_the_kernels_is_the_same_in_another_process(tmp_path):
    """Else each process would compile again."""
    done = python(
        tmp_path,
        "from capture_sim.base.compiled.kernels import code_hash\n"
        "from capture_sim.detection.exact import follow\n"
        "from capture_sim.dynamics.engine.loop import advance\n"
        "print(code_hash(advance), code_hash(follow))",
    )
    assert done.stdout.split() == [code_hash(advance), code_hash(follow)]


@pytest.mark.parametrize("command", ["show tilt_0", "compare --help", "calibrate --help"])
def test_commands_that_compute_nothing_load_no_numba(command):
    code = f"""
import sys

import pytest
from capture_sim.cli import main
try:
    main({command.split()!r})
finally:
    print("numba" in sys.modules, file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.splitlines()[-1] == "False"


#: A .bc file is read only to compile it into another kernel: damaged, it is not noticed here.
DAMAGES = [*itertools.product((".nbi", ".nbc"), ("cut", "changed", "empty", "gone"))]
DAMAGES += [(".bc", "gone")]


@pytest.mark.parametrize("suffix, damage", DAMAGES)
def test_damaged_files_are_compiled_again_in_a_line(suffix, damage, tmp_path):
    """A changed pickle may run any code; one that was cut is an error of any kind."""
    (tmp_path / "mine.py").write_text(MODULE)
    code = "import mine; print(mine.quarter(8.0))"
    assert python(tmp_path, code).stdout == "2.0\n"
    for path in tmp_path.rglob(f"*{suffix}"):
        data = path.read_bytes()
        new = {"cut": data[:-20], "empty": b"", "gone": None}
        new["changed"] = data[:100] + bytes([data[100] ^ 255]) + data[101:]
        path.unlink()
        if new[damage] is not None:
            path.write_bytes(new[damage])
    for _ in range(2):
        found = python(tmp_path, code)
        assert found.stdout == "2.0\n", found.stderr
        assert found.stderr.count("\n") <= 1
        assert "Traceback" not in found.stderr
    assert found.stderr == ""  # it was written again


@pytest.mark.parametrize("mode", [0o777, 0o757])
def test_a_cache_to_which_others_can_write_is_not_used(mode, tmp_path):
    (tmp_path / "mine.py").write_text(MODULE)
    (tmp_path / "capture_sim").mkdir()
    (tmp_path / "capture_sim").chmod(mode)
    found = python(tmp_path, "import mine; print(mine.quarter(8.0))")
    assert found.stdout == "2.0\n"
    assert "others can write to it; compiled kernels go to" in found.stderr
    assert not any((tmp_path / "capture_sim").iterdir())
