"""The programs of the nodes, as functions that load a node and run it.

Until a node is loaded, Ctrl-C ends its process at once.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from functools import partial
from importlib import import_module

from capture_sim.base.exit_status import FAILED, OK, REFUSAL
from capture_sim.base.threads import limit_linear_algebra
from capture_sim.errors import explain_import_error


def start(name: str) -> int:
    """Load the node of this name and run it in this process; return the exit status.

    Loading takes seconds on a busy computer, and an import that Ctrl-C interrupts loses the
    exception or ends in a traceback.  So until the node is loaded, SIGINT and SIGTERM end the
    process at once: nothing needs an orderly shutdown yet.
    """
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, lambda signum, frame: os._exit(OK))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))
    limit_linear_algebra()
    gc.disable()  # modules are no garbage, but looking for it would take 8 % of the loading
    try:
        node = import_module(f"capture_sim.nodes.{name}")
        gc.enable()
        return int(node.main())
    except ImportError as error:  # some message types are loaded with the first subscription
        print(f"{REFUSAL}{explain_import_error(error)}", file=sys.stderr)
        return FAILED


simulator = partial(start, "simulator")
launcher = partial(start, "launcher")
capture_detector = partial(start, "capture_detector")
recorder = partial(start, "recorder")
viewer = partial(start, "viewer")
player = partial(start, "player")
loop_simulator = partial(start, "loop_simulator")
contact_rig = partial(start, "contact_rig")

if __name__ == "__main__":  # python -m capture_sim.nodes.start NAME --ros-args ...
    raise SystemExit(start(sys.argv.pop(1)))
