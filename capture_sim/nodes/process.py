"""A node as a process: callbacks in a thread, Ctrl-C, shutdown in order, an exit status.

The main thread does the node's work, callbacks run in a thread of their own.  SIGINT and SIGTERM
set :data:`capture_sim.interrupts.STOP`; the main thread raises KeyboardInterrupt where it waits
next.
"""

from __future__ import annotations

import inspect
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from capture_sim.errors import CaptureSimError, one_line
from capture_sim.interrupts import STOP, end_within, leave_if_busy, watch_signals
from capture_sim.nodes import dds
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.start import FAILED, OK, REFUSAL, REFUSED
from capture_sim.resources import config_dir

try:
    # a quarter of the plain executor's cost per message; runs no coroutine, and not in every rclpy
    from rclpy.experimental import EventsExecutor
except ImportError:
    EventsExecutor = SingleThreadedExecutor

#: Last messages are given this long to arrive before a node ends, s (wall).
LINGER = 0.3
#: DDS gets this long to shut down, s (wall).
DDS_SHUTDOWN_TIMEOUT = 5
#: A process that was asked to end is ended after this long, s (wall): a disk may be stalled.
SHUTDOWN_TIMEOUT = 10.0


class _Spinner:
    """Runs a node's callbacks in a thread of their own."""

    def __init__(self, node: BenchNode) -> None:
        self._node = node
        self._executor: Executor = (
            SingleThreadedExecutor() if node.has_coroutines else EventsExecutor()
        )
        self._executor.add_node(node)
        self._stop = Future()
        self._thread = threading.Thread(target=self._spin, name="callbacks", daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        try:
            if isinstance(self._executor, SingleThreadedExecutor):
                while not self._stop.done():
                    self._executor.spin_once()
            else:
                # plain spin() of the events executor never runs a callback (rclpy 7.1.6)
                self._executor.spin_until_future_complete(self._stop, 1e9)
        except Exception as error:
            self._node.fail(error)

    def stop(self) -> None:
        """Let the callback that runs come to its end, and no other begin."""
        self._stop.set_result(None)
        # a thread that comes back from C++ when Python ends takes the process with it (SIGABRT)
        while self._thread.is_alive():
            self._executor.create_task(lambda: None)  # wakes it
            self._thread.join(0.1)
        self._executor.shutdown()


def run(
    make: Callable[[], BenchNode],
    args: Sequence[str] | None = None,
) -> int:
    """Make a node, do its work, end in order; return the process's exit status.

    0: done, or ended by Ctrl-C, which is a node's ordinary end; 1: failed; 2: a parameter or the
    scene is wrong.  ``args``: the command line; None for that of the process, which is then to end:
    where DDS does not, it is ended after :data:`DDS_SHUTDOWN_TIMEOUT`.
    """
    if {"-h", "--help"} & set(sys.argv[1:] if args is None else args):
        try:
            print(_usage(make), flush=True)
        except BrokenPipeError:  # e.g. head has read what it wanted
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    watch_signals(STOP)
    threading.Thread(target=_limit_shutdown, name="shutdown", daemon=True).start()
    try:
        hidden = dds.configure(os.environ)
        # rclpy's own handlers shut DDS down at once; ours leave time for the last messages
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        try:
            status = _live(make, hidden)
        finally:
            rclpy.try_shutdown()
        leave_if_busy(status)  # compiling goes on after Ctrl-C
        return status
    except CaptureSimError as error:
        return _refuse(str(error))
    # arguments that rclpy cannot parse (RCLError), parameters of every node, names
    except (RuntimeError, ParameterException, NameValidationException) as error:
        return _refuse(str(error).splitlines()[0])
    except KeyboardInterrupt:  # while the node was made
        leave_if_busy(OK)
        end_within(DDS_SHUTDOWN_TIMEOUT, OK)
        return OK
    finally:
        # Python's own end would give them back their default, by which one more ends the process
        for signum in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signum, signal.SIG_IGN)


def _limit_shutdown() -> None:
    """End the process if it has not ended :data:`SHUTDOWN_TIMEOUT` after it was asked to."""
    STOP.wait()
    time.sleep(SHUTDOWN_TIMEOUT)
    text = f"no shutdown within {SHUTDOWN_TIMEOUT:g} s, e.g. of a stalled disk: process ended"
    print(f"{REFUSAL}{text}", file=sys.stderr, flush=True)
    os._exit(FAILED)


def _refuse(reason: str) -> int:
    print(REFUSAL + one_line(reason), file=sys.stderr, flush=True)
    end_within(DDS_SHUTDOWN_TIMEOUT, REFUSED)
    return REFUSED


def _live(make: Callable[[], BenchNode], hidden: bool) -> int:
    node = make()
    log = node.get_logger()
    if hidden:
        log.info(
            f"discoverable on this machine only; {dds.RANGE}=SUBNET lets other machines take part"
        )
    callbacks = None
    status = FAILED
    interrupted = False
    try:
        node.warn_of_unknown_parameters()
        callbacks = _Spinner(node)
        status = node.work()
    except KeyboardInterrupt:
        interrupted = True
        status = OK
    except CaptureSimError as error:
        log.error(str(error))
    finally:
        if callbacks is not None:
            if interrupted and node.failure is None:
                node.await_run_end()
            callbacks.stop()
        if node.failure is not None:
            log.error(_one_line(node.failure))
            status = FAILED
        elif interrupted:
            node.interrupted()
        node.drain(LINGER)
        end_within(DDS_SHUTDOWN_TIMEOUT, status)
        node.destroy_node()
    return status


def _one_line(error: Exception) -> str:
    kind = "" if isinstance(error, CaptureSimError) else f"stopped by {type(error).__name__}: "
    return one_line(f"{kind}{error}")


def _usage(make: Callable[..., object]) -> str:
    """Return how this process's node is called, what it does, and which parameters it has."""
    program = Path(sys.argv[0]).name
    name = Path(program).stem.removeprefix("capture-sim-").replace("-", "_")
    file = config_dir() / "nodes.yaml"
    sections = file.read_text(encoding="utf-8").split("\n/**/")
    lines = [
        f"usage: {program} [--ros-args -p NAME:=VALUE ... --params-file FILE -r NAME:=NAME ...]",
        "",
        inspect.getdoc(make) or "",
        "",
    ]
    for section in sections:
        if section.startswith(f"{name}:"):
            lines += [f"Parameters and their defaults ({file}):", "", section.rstrip(), ""]
    lines.append(f"`ros2 param describe /{name} PARAMETER` prints the range while the node runs.")
    return "\n".join(lines)
