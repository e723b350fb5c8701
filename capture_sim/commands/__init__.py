"""The commands of ``capture-sim``, one module each.

A command's module has ``HELP`` (one line), ``DESCRIPTION``, ``add_arguments(parser)`` and
``run(options)``, which returns the exit status.  All are loaded whenever one is called: what is
slow to import is imported within ``run``.
"""

#: In the order of ``capture-sim --help``; each the name of a module here.
COMMANDS = (
    "run",
    "bench",
    "view",
    "report",
    "replay",
    "recover",
    "detect",
    "resimulate",
    "compare",
    "export",
    "identify",
    "design",
    "sensitivity",
    "envelope",
    "reproduce",
    "scenes",
    "show",
)
