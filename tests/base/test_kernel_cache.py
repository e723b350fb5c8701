"""Compiled kernels on disk: what a second process loads."""

import os
import subprocess
import sys

import pytest

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


def python(folder, code):
    environment = os.environ | {"CAPTURE_SIM_CACHE": str(folder), "PYTHONPATH": str(folder)}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


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
    refused = python(tmp_path, "import mine; mine.quarter(8.0); print(mine.eighth(8.0))")
    assert refused.returncode != 0
    assert text.name in refused.stderr


@pytest.mark.parametrize("command", ["show tilt_0", "compare --help", "identify --help"])
def test_commands_that_compute_nothing_load_no_numba(command, tmp_path):
    code = f"""
import sys

import pytest
from capture_sim.cli import main
try:
    main({command.split()!r})
finally:
    print("numba" in sys.modules, file=sys.stderr)
"""
    assert python(tmp_path, code).stderr.splitlines()[-1] == "False"
