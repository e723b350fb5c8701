"""Rules of plausibility: is what a laboratory has measured a measurement of this bench?

Takes: ``Measured``: stamps, arrivals, poses, buffer and force as arrays; a scene or none.
Gives: ``Doubt``, each with its rule, topic and a line that says what to do.
Must not know: Messages, files and ROS; what a verdict is.
Begin with: ``check.py``.
"""
