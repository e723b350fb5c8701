"""Rules of plausibility: can a laboratory's data be measurements of this bench?

Takes: ``Measured``: stamps, arrivals, poses, buffer and force as arrays; a scene, or None.
Gives: A ``Doubt`` for each finding: the rule, the topic and a line that says what to do.
Must not know: Messages, files and ROS; what a verdict is.
Begin with: ``check.py``.
"""
