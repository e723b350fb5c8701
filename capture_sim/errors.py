"""Errors that reach a user; each message is one line that names the cause."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np


class CaptureSimError(Exception):
    """Base class of all errors of capture_sim."""


class SceneError(CaptureSimError):
    """A scene, or a change to it, is invalid.

    The message names the field, the value, the unit and the allowed range.
    """


class SimulationError(CaptureSimError):
    """The integration stopped early; the samples up to the stop are in ``partial``.

    The message names the simulated time, the phase and the cause.

    Attributes
    ----------
    partial
        Samples of the interrupted call up to the stop, (n,) of dtype SAMPLE.
    """

    def __init__(self, message: str, partial: np.ndarray) -> None:
        super().__init__(message)
        self.partial = partial

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the arguments for unpickling the error, including ``partial``.

        Without them, an error of a worker process could not be unpickled and would break its pool.
        """
        return type(self), (*self.args, self.partial)


class MemoryLimitError(CaptureSimError):
    """A recording needs more memory than is permitted."""


class RecordingError(CaptureSimError):
    """A recording or another file cannot be written or read, or a recorded run cannot be used."""


class MessageError(RecordingError):
    """A received or recorded message is invalid; the text gives the reason."""


class MissingPackageError(CaptureSimError):
    """A required optional package is not installed; the message names it."""


#: Packages that each extra of pyproject.toml installs, by the name they are imported under.
_EXTRAS = {
    "view": ("rerun",),
    "study": ("SALib", "pandas", "pyarrow", "pymoo"),
    "cluster": ("dask", "distributed"),
}
_ROS_PACKAGES = ("ament_index_python", "rcl_interfaces", "rclpy", "rosidl_runtime_py")


def explain_import_error(error: ImportError) -> str:
    """Return one line that explains an import error.

    For a missing package of ROS 2 or of an extra, the line says how to install the package.  For a
    package that is installed but whose import fails, it gives the reason.
    """
    package = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError):
        return f"{package or 'a package'}: its import fails: {one_line(str(error))}"
    if (error.name or "").startswith(("capture_sim.msg", "capture_sim.srv", "capture_sim.action")):
        return (
            "the ROS messages are not compiled: run 'make setup' in a clone of capture_sim, "
            "or build it with colcon"
        )
    if package in _ROS_PACKAGES:
        return (
            "ROS 2 is not installed: source an installation of it, "
            "or run 'make setup' in a clone of capture_sim"
        )
    for extra, packages in _EXTRAS.items():
        if package in packages:
            return f"{package} is not installed: {install_hint(extra)}"
    return one_line(str(error))


def import_failure(needs: str, error: ImportError, extra: str) -> str:
    """Return one line that explains why a package of an extra cannot be imported.

    ``needs`` says what requires the package, e.g. ``"Parquet needs pyarrow"``.  For a missing
    package, the line says how to install it.  An installed package whose import fails often does
    not match the version of another package; the line then gives the error and where to find
    matching versions.
    """
    if isinstance(error, ModuleNotFoundError):
        return f"{needs}: {install_hint(extra)}"
    return (
        f"{needs}, whose import fails: {one_line(str(error))}; "
        "versions that work together are in requirements/"
    )


def install_hint(extra: str) -> str:
    """Return the pip command that installs an extra of capture_sim from a clone.

    A clone is required because capture_sim is not on a package index.
    """
    return f"pip install '.[{extra}]' in a clone of capture_sim"


def one_line(text: str) -> str:
    """Return a text in one line of about 1000 characters at most, without control characters."""
    text = "".join(c if c.isprintable() else " " for c in text)
    text = " ".join(text.split())
    return text if len(text) <= 1000 else f"{text[:700]} ... {text[-290:]}"
