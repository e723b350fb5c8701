"""Exit statuses of commands and nodes, and the lines by which a node's process reports.

A command starts nodes as processes of their own: it knows their statuses and lines, not their code.
"""

#: Success, also of a node that Ctrl-C ended; failure or a negative result; bad input; interrupted.
OK, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
#: Start of the line with which a node reports why it refused to run.
REFUSAL = "error: "
#: The recorder's line about its file ends with this text and the file.
RECORDING_IN = "recording in "
