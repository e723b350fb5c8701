"""What pip installs: each set of extras in an environment of its own.

The environments are made by uv from its cache, which the project's set-up has filled.  What the
extra ros is for, compiled messages and nodes, is what `make setup` and the tests of nodes do.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
UV = Path(sys.prefix, "bin", "uv")
pytestmark = pytest.mark.skipif(not UV.is_file(), reason="uv is not installed")


def environment():
    """Return the variables of a shell in which no ROS is sourced."""
    ros = ("AMENT_", "CMAKE_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHON", "VIRTUAL_ENV", "ROS_")
    ros += ("_ROS_WHEELS",)  # says that the wheels have set their paths
    return {name: value for name, value in os.environ.items() if not name.startswith(ros)}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Return the wheel that pip builds of a clean copy where there is no ROS."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("capture_sim", "config", "launch", "msg", "srv", "action"):
        subprocess.run(["cp", "-r", ROOT / name, source / name], check=True)
    for name in ("LICENSE", "README.md", "pyproject.toml", "setup.py"):
        subprocess.run(["cp", ROOT / name, source / name], check=True)
    build = [UV, "build", "--wheel", "--quiet", "--out-dir", out, source]
    subprocess.run(build, check=True, env=environment())
    return next(out.glob("*.whl"))


SETS = {"base": "", **{name: f"[{name}]" for name in ("view", "study", "cluster", "ros")}}


@pytest.fixture(scope="module", params=SETS.values(), ids=SETS)
def installed(request, wheel, tmp_path_factory):
    """Return the folder of programs of an environment with one set of extras, and the set.

    The base gets the versions of an apt Jazzy's workstation: NumPy 1.26.
    """
    folder = tmp_path_factory.mktemp("venv")
    lock = "lock.txt" if request.param else "workstation.txt"
    subprocess.run([UV, "venv", "-q", "--python", sys.executable, folder / "env"], check=True)
    packages = [
        "-c",
        ROOT / "requirements" / lock,
        f"capture_sim{request.param} @ {wheel.as_uri()}",
    ]
    install = [UV, "pip", "install", "-q", "--python", folder / "env" / "bin" / "python", *packages]
    subprocess.run(install, check=True, env=environment())
    return folder / "env" / "bin", request.param


def call(installed, program, *arguments, folder):
    """Run a program as installed, away from the sources; return status, output and errors."""
    done = subprocess.run(
        [installed[0] / program, *arguments],
        cwd=folder,
        env=environment() | {"CAPTURE_SIM_CACHE": str(folder / "cache")},
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout, done.stderr


HELP = """
import contextlib, io
from capture_sim.cli import main
from capture_sim.commands import COMMANDS
for command in COMMANDS:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        status = main([command, "--help"])
    assert (status, out.getvalue().split()[:3]) == (0, ["usage:", "capture-sim", command]), command
"""


def test_every_command_shows_its_help(installed, tmp_path):
    assert call(installed, "python", "-c", HELP, folder=tmp_path) == (0, "", "")


def test_commands_that_need_more_name_it(installed, tmp_path):
    status, _, errors = call(installed, "capture-sim", "bench", "tilt_0", folder=tmp_path)
    assert (status, errors.count("\n")) == (1, 1)
    lacking = "ROS 2 is not installed: source an installation"
    if installed[1] == SETS["ros"]:
        lacking = "the ROS messages are not compiled: run 'make setup'"
    assert errors.startswith(f"capture-sim: {lacking}")
    status, _, errors = call(installed, "capture-sim-recorder", folder=tmp_path)
    assert (status, errors.count("\n")) == (1, 1), errors
    assert errors.startswith(f"error: {lacking}")
    if installed[1] not in ("[study]", "[cluster]"):
        sweep = ("sweep", "tilt_0", "--vary", "buffer.c_A=10,20")
        status, _, errors = call(installed, "capture-sim", *sweep, folder=tmp_path)
        assert (status, errors.count("\n")) == (2, 1)
        assert "pip install '.[study]' in a clone of capture_sim" in errors


CLUSTER = """
import math
from capture_sim.studies.executors import ExecutorError, answers, open_executor
address = "tcp://127.0.0.1:9"
try:
    from distributed import LocalCluster
    cluster = LocalCluster(n_workers=1, processes=False, dashboard_address=None)
    address = cluster.scheduler_address
except ImportError:
    pass
try:
    with open_executor(scheduler=address) as executor:
        print(list(answers(executor, math.sqrt, [4.0, 9.0])))
except ExecutorError as error:
    print(error)
"""


def test_a_cluster_works_where_its_extra_is_installed_and_is_named_elsewhere(installed, tmp_path):
    status, printed, _ = call(installed, "python", "-c", CLUSTER, folder=tmp_path)
    hint = "pip install '.[cluster]' in a clone of capture_sim"
    expected = f"--scheduler: Dask is not installed; {hint}"
    if installed[1] == SETS["cluster"]:
        expected = "[2.0, 3.0]"
    assert (status, printed.strip()) == (0, expected)


FIRST_CALL = """
import numpy, capture_sim
assert numpy.__version__ == "1.26.4"
capture_sim.simulate("tilt_0")
"""


def test_the_first_call_says_that_it_compiles_and_a_run_is_recorded_drawn_and_read_again(
    installed, tmp_path
):
    if installed[1]:
        pytest.skip("compiles the kernels: once is enough")
    calls = [call(installed, "python", "-c", FIRST_CALL, folder=tmp_path) for _ in range(2)]
    assert [status for status, *_ in calls] == [0, 0]
    compiling, compiled = calls[0][2].splitlines()
    assert compiling.startswith("capture_sim: compiling the kernels, once for this version")
    assert re.fullmatch(r"capture_sim: compiled in \d+ s", compiled)
    assert calls[1][2] == ""
    status, out, _ = call(installed, "capture-sim", "run", "tilt_p10", folder=tmp_path)
    assert status == 0
    assert "captured" in out
    runs = tmp_path / "runs"
    assert (runs / "tilt_p10.png").stat().st_size > 20_000
    status, out, _ = call(
        installed, "capture-sim", "detect", runs / "tilt_p10.mcap", folder=tmp_path
    )
    assert status == 0
    assert "captured" in out
