"""The commands of ``capture-sim``, one module each.

The module of a command has ``DESCRIPTION``, ``EXAMPLE``, ``add_arguments(parser)`` and
``run(options)``, which returns the exit status.  An optional text ``FAILS`` says when this command
returns 1, in addition to the reasons that apply to all commands
(``base/exit_status.py``, ``OF_COMMANDS``).  The module is imported only when the command is called,
so it may import everything that it needs at its top.

Takes: Arguments of the command line.
Gives: Lines, tables and files, and an exit status (``base/exit_status.py``).
Must not know: ROS and the code of the nodes, because it starts them as processes (``suite.py``).
Begin with: ``run.py``.
"""

from __future__ import annotations

#: Groups of commands with one line each, as ``capture-sim --help`` lists them.
GROUPS = {
    "simulate": {
        "run": "run scenes without ROS",
        "bench": "run scenes with the ROS 2 nodes",
        "scenes": "list the scenes of the package",
        "show": "print a scene with all its values, as YAML",
        "fmu": "write a scene as an FMI 3.0 unit or as a library in C",
    },
    "look": {
        "view": "draw runs as plots and for the rerun viewer",
        "report": "write an HTML report of runs",
        "replay": "play a recording with ROS 2",
        "export": "write a recording as CSV, NumPy or Parquet",
    },
    "examine": {
        "inspect": "say what recordings are worth, before anything is judged or fitted",
        "detect": "evaluate a recorded run again, with the same or other criteria",
        "compare": "compare two runs, e.g. measured and simulated",
    },
    "study": {
        "calibrate": "fit the parameters of a bench to its trials, and predict the next one",
        "design": "find the buffers that capture within limits, and that no other beats",
        "paper": "design a buffer as in the paper, for the strokes of the first contact",
        "sweep": "run a scene over values, distributions or a table",
    },
}

#: Titles in a command's help, and the options below them; others stand below "options".
OPTIONS = {
    "what is asked for": (
        *("--minimize", "--maximize", "--approach", "--capture-range", "--pick", "--window"),
        *("--allow-leaving", "--allow-passing", "--stroke-limit", "--torsion-limit"),
        *("--peak-force", "--limit", "--costs", "--fit", "--predict", "--placement"),
    ),
    "what is varied, and what is uncertain": (
        *("--free", "--vary", "--under", "--correlate", "--calibrated", "--confidence", "--draws"),
        *("--weighed", "--uncertain", "--edges", "--runs", "--sample"),
    ),
    "recordings": ("--scene", "--waive", "--release", "--remap", "--memory", "--trial", "--until"),
    "how it is computed": (
        *("--workers", "--scheduler", "--seed", "--candidates", "--from", "--resume", "--check"),
        *("--restarts", "--touches"),
    ),
    "what is written": ("--out", "--overwrite", "--json", "--no-record", "--verbose", "--to"),
}

#: Commands of earlier versions, and what does their work now.
FORMER = {"identify": "calibrate RUN.mcap --fit NAME ..."}

COMMANDS = tuple(name for group in GROUPS.values() for name in group)
