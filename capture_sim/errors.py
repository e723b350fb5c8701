"""The errors a user meets; each message is one line that says what to mend."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from capture_sim.simulation import Result


class CaptureSimError(Exception):
    """Base of all errors that capture_sim raises on purpose."""


class SceneError(CaptureSimError):
    """A scene, or a change to one, is not usable.

    The message names the field, the value, the unit and the allowed range.
    """


class SimulationError(CaptureSimError):
    """The integration had to stop; what was computed before stays available.

    The message names the simulated time, the phase and the cause.

    Attributes
    ----------
    partial
        The samples of the interrupted call up to there, (n,) of dtype SAMPLE.
    result
        The run up to there, where :func:`capture_sim.simulate` raised it.
    """

    result: Result | None = None

    def __init__(self, message: str, partial: np.ndarray) -> None:
        super().__init__(message)
        self.partial = partial


class RecordingError(CaptureSimError):
    """A recording could not be written or read."""


class MessageError(RecordingError):
    """A message from outside, live or recorded, is not usable; the text says why."""


class MissingPackageError(CaptureSimError):
    """An optional package is asked for that is not installed; the message names it."""


#: Packages that each extra of pyproject.toml installs, by the name they are imported under.
_EXTRAS = {
    "view": ("plotly", "rerun"),
    "study": ("SALib", "pandas", "pyarrow"),
    "cluster": ("dask", "distributed"),
}
_ROS_PACKAGES = ("ament_index_python", "rcl_interfaces", "rclpy", "rosidl_runtime_py")


def explain_import_error(error: ImportError) -> str:
    """Return one line that says which package is missing and how to install it."""
    package = (error.name or "").partition(".")[0]
    if (error.name or "").startswith(("capture_sim.msg", "capture_sim.srv")):
        return "the ROS messages are not compiled: install capture_sim where ROS 2 is installed"
    if package in _ROS_PACKAGES:
        return (
            "ROS 2 is not installed: source an installation of it, "
            "or run 'make setup' in a clone of capture_sim"
        )
    for extra, packages in _EXTRAS.items():
        if package in packages:
            return f"{package} is not installed: pip install 'capture_sim[{extra}]'"
    return str(error)


def one_line(text: str) -> str:
    """Return a text without line breaks and control characters, shortened where it is endless."""
    text = "".join(c if c.isprintable() else " " for c in text)
    text = " ".join(text.split())
    return text if len(text) <= 1000 else f"{text[:700]} ... {text[-290:]}"
