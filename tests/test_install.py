"""What pip installs: each set of extras in an environment of its own.

The environments are made by uv from its cache, which the project's set-up has filled.  What the
extra ros is for, compiled messages and nodes, is what `make setup` and the tests of nodes do.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
UV = Path(sys.prefix, "bin", "uv")
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not UV.is_file(), reason="uv is not installed"),
]


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


#: Extras, and what their environment lacks for `bench`: nothing is asked of those left out here.
SETS = {"base": "", "cluster": "[cluster]", "ros": "[ros]"}


@pytest.fixture(scope="module", params=SETS)
def installed(request, wheel, tmp_path_factory):
    """Return the folder of programs of an environment with one set of extras, and its name.

    The base gets the versions of an apt Jazzy's workstation: NumPy 1.26.
    """
    folder, extras = tmp_path_factory.mktemp("venv"), SETS[request.param]
    lock = ROOT / "requirements" / ("lock.txt" if extras else "workstation.txt")
    subprocess.run([UV, "venv", "-q", "--python", sys.executable, folder / "env"], check=True)
    install = [UV, "pip", "install", "-q", "--python", folder / "env" / "bin" / "python"]
    install += ["-c", lock, f"capture_sim{extras} @ {wheel.as_uri()}"]
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
CLUSTER = """
import math
from capture_sim.studies.evaluate.executors import ExecutorError, answers, open_executor
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


def test_what_an_extra_brings_works_and_what_is_lacking_is_named(installed, tmp_path):
    extra = installed[1]
    if extra == "base":  # the least that there can be
        assert call(installed, "python", "-c", HELP, folder=tmp_path) == (0, "", "")
    lacking = "messages are not compiled" if extra == "ros" else "ROS 2 is not installed"
    for program in (["capture-sim", "bench", "tilt_0"], ["capture-sim-recorder"]):
        status, _, errors = call(installed, *program, folder=tmp_path)
        assert (status, errors.count("\n"), lacking in errors) == (1, 1, True), errors
    if extra == "base":
        sweep = ("sweep", "tilt_0", "--vary", "buffer.c_A=10,20")
        status, _, errors = call(installed, "capture-sim", *sweep, folder=tmp_path)
        assert (status, errors.count("\n"), "'.[study]'" in errors) == (2, 1, True), errors
    status, printed, _ = call(installed, "python", "-c", CLUSTER, folder=tmp_path)
    assert status == 0
    assert ("[2.0, 3.0]" if extra == "cluster" else "'.[cluster]'") in printed


def test_the_first_run_says_that_it_compiles_and_is_recorded_drawn_and_read_again(
    installed, tmp_path
):
    if installed[1] != "base":
        pytest.skip("compiles the kernels: once is enough")
    version = "import numpy; assert numpy.__version__ == '1.26.4'"
    assert call(installed, "python", "-c", version, folder=tmp_path)[0] == 0
    status, out, errors = call(installed, "capture-sim", "run", "tilt_p10", folder=tmp_path)
    assert (status, "captured" in out, "compil" in errors) == (0, True, True)
    assert (tmp_path / "runs" / "tilt_p10.png").stat().st_size > 20_000
    recording = tmp_path / "runs" / "tilt_p10.mcap"
    status, out, errors = call(installed, "capture-sim", "detect", recording, folder=tmp_path)
    assert (status, "captured" in out, "compil" in errors) == (0, True, False)
