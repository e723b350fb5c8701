"""Recordings: runs written as MCAP files that ROS tools can read, and files read back as runs.

Takes: A ``Run`` or live messages; or a file or folder.
Gives: A file; or a ``Run``, tables, messages to play.
Must not know: ROS nodes and plots.
Begin with: ``read.py``.
"""
