"""Exit statuses of commands and nodes, and the beginnings of lines by which a node reports.

A command that starts nodes runs each one in a process of its own.  It learns what a node did from
the exit status and these lines.
"""

#: Success, also of a node that Ctrl-C ended; failure or a negative result; bad input; interrupted.
OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
#: Meaning of each exit status of a command; ``FAILS`` in its module adds one to FAILED.
OF_COMMANDS = {
    OK: "success",
    FAILED: "a run cannot be continued, a package is missing, or the command's own reason",
    BAD_INPUT: "an argument, a scene or a file that cannot be used, in one line",
    INTERRUPTED: "Ctrl-C",
}
#: Meaning of each exit status of a node.
OF_NODES = {
    OK: "done, or ended by Ctrl-C, and no run has failed",
    FAILED: "a run failed, or a message is missing",
    BAD_INPUT: "a parameter or the scene is wrong: one line with name, value and range",
}
#: Start of the line with which a node reports why it refused to run.
REFUSAL = "error: "
#: The recorder's line about its file ends with this text and the path of the file.
RECORDING_IN = "recording in "
