"""The launcher: it compares a launch with its plan."""
