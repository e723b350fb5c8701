"""Python in a process of its own, forked from one that has loaded Numba, which saves a second.

Nothing of the package but its compiler is loaded there, and no folder of compiled kernels chosen.
"""

import multiprocessing
import os
import sys
import tempfile
import traceback
from pathlib import Path
from types import SimpleNamespace

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["capture_sim.base.compiled.kernels", "numba"])


def python(code, folder, **environment):
    """Run ``code``, which finds modules in ``folder``; return its output and exit status."""
    with tempfile.TemporaryDirectory() as place:
        files = Path(place, "stdout"), Path(place, "stderr")
        process = _CONTEXT.Process(target=_run, args=(code, str(folder), environment, files))
        process.start()
        process.join()
        stdout, stderr = (file.read_text() for file in files)
    return SimpleNamespace(stdout=stdout, stderr=stderr, returncode=process.exitcode)


def _run(code, folder, environment, files):
    for number, file in enumerate(files, 1):
        os.dup2(os.open(file, os.O_CREAT | os.O_WRONLY), number)
    os.environ.update(environment)
    sys.path.insert(0, folder)
    status = 0
    try:
        exec(code, {"__name__": "__main__"})
    except SystemExit as leaving:
        status = int(leaving.code or 0)
    except BaseException:
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
