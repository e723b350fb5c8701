"""A node as a process: Ctrl-C, orderly shutdown, exit status.

SIGINT and SIGTERM set :data:`capture_sim.base.interrupts.STOP`; the node's next wait raises
KeyboardInterrupt.
"""

from __future__ import annotations

import inspect
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from capture_sim.base.exit_status import BAD_INPUT, FAILED, OK, REFUSAL
from capture_sim.base.interrupts import STOP, end_within, leave_if_busy, watch_signals
from capture_sim.base.resources import config_dir
from capture_sim.base.version import __version__
from capture_sim.errors import CaptureSimError, one_line
from capture_sim.nodes.base import dds
from capture_sim.nodes.base.endpoints import TRANSIT_TIME
from capture_sim.nodes.base.node import BenchNode, named_end_error

#: Maximum time for the shutdown of DDS, s (wall).
DDS_SHUTDOWN_TIMEOUT = 5
#: Maximum time from the request to end to the end of the process, s (wall), e.g. with a stalled
#: disk.
SHUTDOWN_TIMEOUT = 10.0


def run(
    make: Callable[[], BenchNode],
    args: Sequence[str] | None = None,
) -> int:
    """Create a node, do its work and shut down in order; return the process's exit status.

    Status 0: done, or ended by Ctrl-C, which is a node's ordinary end.  Status 1: the node or one
    of its runs has failed.  Status 2: a parameter or the scene is invalid.  ``args``: command line,
    None for the command line of the process.  The process must end after this call: if DDS does not
    shut down, the process is ended after :data:`DDS_SHUTDOWN_TIMEOUT`.
    """
    words = list(sys.argv[1:] if args is None else args)
    if "--version" in words:
        print(f"capture_sim {__version__}", flush=True)
        return OK
    if not {"-h", "--help"} & set(words):
        own = remove_ros_args(["program", *words])[1:]
        if own:
            hint = "parameters are given by --ros-args -p NAME:=VALUE, see --help"
            return _refuse_early(f"{own[0]!r}: not an argument of this program; {hint}")
    if {"-h", "--help"} & set(words):
        try:
            print(_usage(make), flush=True)
        except BrokenPipeError:  # e.g. head has closed the pipe
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    watch_signals(STOP)
    threading.Thread(target=_limit_shutdown, name="shutdown", daemon=True).start()
    try:
        hidden = dds.configure(os.environ)
        # rclpy's handlers shut DDS down at once; capture_sim's leave time for the last messages
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        try:
            status = _live(make, hidden)
        finally:
            rclpy.try_shutdown()
        leave_if_busy(status)  # compiling continues after Ctrl-C
        return status
    except CaptureSimError as error:
        return _refuse(str(error))
    # arguments that rclpy cannot parse (RCLError), invalid common parameters, invalid names
    except (RuntimeError, ParameterException, NameValidationException) as error:
        return _refuse(str(error).splitlines()[0])
    except KeyboardInterrupt:  # while the node was created
        leave_if_busy(OK)
        end_within(DDS_SHUTDOWN_TIMEOUT, OK)
        return OK
    finally:
        # Python's shutdown would restore the default handlers; a further signal would then kill
        # the process
        for signum in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signum, signal.SIG_IGN)


def _wake_at_end(node: BenchNode) -> None:
    """Wake a node at once when its process is asked to end."""
    node.end_request.wait()
    node.wake()


def _limit_shutdown() -> None:
    """End the process :data:`SHUTDOWN_TIMEOUT` after the request to end, if it still runs."""
    STOP.wait()
    time.sleep(SHUTDOWN_TIMEOUT)
    text = f"no shutdown within {SHUTDOWN_TIMEOUT:g} s, e.g. of a stalled disk: process ended"
    with suppress(OSError):  # the process that reads the text may have been killed
        print(f"{REFUSAL}{text}", file=sys.stderr, flush=True)
    os._exit(FAILED)


def _refuse_early(reason: str) -> int:
    print(REFUSAL + one_line(reason), file=sys.stderr, flush=True)
    return BAD_INPUT


def _refuse(reason: str) -> int:
    _refuse_early(reason)
    end_within(DDS_SHUTDOWN_TIMEOUT, BAD_INPUT)
    return BAD_INPUT


def live(node: BenchNode) -> int:
    """Let a node work to its end in the calling thread; return the exit status.

    Before it returns, sent messages get :data:`TRANSIT_TIME` to arrive.
    """
    log = node.get_logger()
    try:
        node.warn_of_unknown_parameters()
        status = node.work()
    except KeyboardInterrupt:
        status = node.exit_status
    except CaptureSimError as error:
        log.error(str(error))
        status = FAILED
    except Exception as error:
        log.error(named_end_error(error))
        log.debug("".join(traceback.format_exception(error)))
        status = FAILED
    node.report_rejections()
    node.topic_publishers.drain(TRANSIT_TIME)
    return status


def _live(make: Callable[[], BenchNode], hidden: bool) -> int:
    node = make()
    if hidden:
        node.get_logger().info(
            f"discoverable on this machine only; {dds.RANGE}=SUBNET lets other machines take part"
        )
    threading.Thread(target=_wake_at_end, args=[node], name="end", daemon=True).start()
    status = FAILED
    try:
        status = live(node)
    finally:
        end_within(DDS_SHUTDOWN_TIMEOUT, status)
        node.close()
    return status


def _usage(make: Callable[..., object]) -> str:
    """Return the help of this process's node: usage, purpose and parameters."""
    program = Path(sys.argv[0]).name
    name = Path(program).stem.removeprefix("capture-sim-").replace("-", "_")
    file = config_dir() / "nodes.yaml"
    sections = file.read_text(encoding="utf-8").split("\n/**/")
    lines = [
        f"usage: {program} [--ros-args -p NAME:=VALUE ... --params-file FILE -r NAME:=NAME ...]",
        "",
        (inspect.getdoc(make) or "").replace("``", "`"),
        "",
    ]
    for section in sections:
        if section.startswith(f"{name}:"):
            lines += [f"Parameters, from {file}:", "", section.rstrip(), ""]
    lines.append(f"`ros2 param describe /{name} PARAMETER` prints the range while the node runs.")
    return "\n".join(lines)
