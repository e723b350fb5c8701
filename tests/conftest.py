"""Keeps what the tests start apart from everything else on the machine."""

import fcntl
import io
import os
import shutil
import signal
import tempfile
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as commands and nodes have it; before NumPy is loaded

import hypothesis
import pytest
from cases import all_cases, cases
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from capture_sim import load_scene
from capture_sim.base.compiled.kernels import cache_folder
from capture_sim.commands.compiling import compile_first
from capture_sim.hardware.stage import LoopStage
from tests.domains import claim_domain

# A shell starts what is in its background with Ctrl-C ignored, and the nodes would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# a busy machine is no failure, and every run tries the same cases
hypothesis.settings.register_profile(
    "untimed", deadline=None, derandomize=True, max_examples=cases(few=30, all=100)
)
hypothesis.settings.load_profile("untimed")

#: Files of long tests: begun last, one runs on while the other workers have nothing left.
LONG = ("test_design.py", "test_docs.py", "test_install.py", "test_injections.py")
LONG += ("test_second_formulation.py", "test_sweep.py", "test_loop_faults.py", "test_trials.py")

# At import: the environment must stand before anything loads rclpy.
_domain, _lock = claim_domain()
_log_dir = tempfile.mkdtemp(prefix="capture_sim_ros_log_")
os.environ["ROS_DOMAIN_ID"] = str(_domain)
os.environ["ROS_LOG_DIR"] = _log_dir
# for those that listen in; the nodes take both by themselves
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    Path(__file__).resolve().parent.parent / "config" / "fast_dds_loopback.xml"
)


def pytest_collection_modifyitems(config, items):
    """Leave out what is long, unless all is tried; begin with what takes longest."""
    if not all_cases():
        long = [item for item in items if item.get_closest_marker("long")]
        items[:] = [item for item in items if not item.get_closest_marker("long")]
        config.hook.pytest_deselected(items=long)
    items.sort(key=lambda item: item.path.name not in LONG)


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session):
    """Compile the kernels once, and in no test's time: each worker would do it for itself.

    `make test` has two sessions at a time: the second waits for what the first compiles.
    """
    if not session.config.option.collectonly and "PYTEST_XDIST_WORKER" not in os.environ:
        with (cache_folder() / "tests.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            compile_first()
            LoopStage(load_scene("_loop"))


@pytest.fixture(scope="session", autouse=True)
def _loaded():
    """Load what draws once: commands fork a process for each file, which would load it again."""
    with suppress(ImportError):  # a system's ROS has no rerun
        import_module("capture_sim.viewing.rerun_view")


@pytest.fixture(scope="session", autouse=True)
def _one_core():
    """Make the runs of studies in this process: other cores have tests to run.

    Each new process would load the kernels.  tests/studies compares both, and names the number.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "sched_getaffinity", lambda pid: {0})
        yield


def _save_blank(figure, file, format=None, **_):
    """Save one pixel in place of a figure."""
    kind = format or Path(file).suffix[1:]
    data = b"<svg xmlns='http://www.w3.org/2000/svg'/>" if kind == "svg" else _pixel()
    if hasattr(file, "write"):
        file.write(data)
    else:
        Path(file).write_bytes(data)


@cache
def _pixel():
    file = io.BytesIO()
    mark = PngInfo()
    mark.add_text("Software", "capture_sim")  # as every picture of it has
    Image.new("RGB", (1, 1)).save(file, "png", pnginfo=mark)
    return file.getvalue()


def _save_no_rrd(runs, path, *_):
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).touch()
    return Path(path)


@pytest.fixture
def blank_pictures(monkeypatch):
    """Save every picture as one pixel, and an empty file for rerun with a run's pictures."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", _save_blank)
    # by its module: a test that hides a package leaves another capture_sim.viewing in its parent
    report = import_module("capture_sim.viewing.report")
    monkeypatch.setattr(report, "small_png", lambda figure, dpi: _pixel())
    with suppress(ImportError):  # a system's ROS has no rerun
        rerun_view = import_module("capture_sim.viewing.rerun_view")
        monkeypatch.setattr(rerun_view, "save_rrd", _save_no_rrd)


@pytest.fixture
def drawn():
    """For a test that looks at pictures: outside tests/viewing, others have one pixel."""


@pytest.fixture(autouse=True)
def pictures(request):
    """Draw nothing at which no test looks."""
    if "drawn" not in request.fixturenames:
        request.getfixturevalue("blank_pictures")


def pytest_unconfigure():
    """Let the domain go and remove the logs."""
    _lock.close()
    shutil.rmtree(_log_dir, ignore_errors=True)
