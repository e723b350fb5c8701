"""Exit statuses of commands and nodes, and the lines by which a node's process reports.

A command starts nodes as processes of their own: it knows their statuses and lines, not their code.
"""

#: Success, also of a node that Ctrl-C ended; failure or a negative result; bad input; interrupted.
OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
#: What a status says of a command; FAILED also that a command's own ``FAILS`` holds.
OF_COMMANDS = {
    OK: "success",
    FAILED: "a run cannot be continued, a package is missing, or the command's own reason",
    BAD_INPUT: "an argument, a scene or a file that cannot be used, in one line",
    INTERRUPTED: "Ctrl-C",
}
#: What it says of a node.
OF_NODES = {
    OK: "done, or ended by Ctrl-C, and no run has failed",
    FAILED: "a run failed, or a message is missing",
    BAD_INPUT: "a parameter or the scene is wrong: one line with name, value and range",
}
#: Start of the line with which a node reports why it refused to run.
REFUSAL = "error: "
#: The recorder's line about its file ends with this text and the file.
RECORDING_IN = "recording in "
