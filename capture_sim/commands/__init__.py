"""The commands of ``capture-sim``, one module each.

A command's module has ``DESCRIPTION``, ``EXAMPLE``, ``add_arguments(parser)`` and
``run(options)``, which returns the exit status.  It is imported when it is called, and may so
import at its top whatever it needs.
"""

from __future__ import annotations

#: Exit statuses: fine, the command's own no, bad input, interrupted.
OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

#: What ``capture-sim --help`` lists: in groups, each command with one line.
GROUPS = {
    "simulate": {
        "run": "run experiments without ROS",
        "bench": "run experiments with the ROS 2 nodes",
        "scenes": "list the scenes that come with the package",
        "show": "print a scene with all its values, as YAML",
    },
    "look": {
        "view": "draw recorded runs",
        "report": "one page about runs, to keep or to print",
        "replay": "play a recording with ROS 2",
        "export": "write a recording as CSV, NumPy or Parquet",
    },
    "examine": {
        "detect": "judge a recorded run anew, with other limits if wanted",
        "compare": "hold two recordings against each other, as measured and simulated",
        "resimulate": "simulate a recorded run again and compare state by state",
        "recover": "copy a damaged recording up to the damage",
    },
    "study": {
        "identify": "fit parameters of the bench to a recorded run",
        "design": "find springs and damper for the strokes you want",
        "sweep": "run a scene over values, distributions or a table",
    },
}

COMMANDS = tuple(name for group in GROUPS.values() for name in group)
