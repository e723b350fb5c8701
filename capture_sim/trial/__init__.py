"""A trial of a real bench: when it may release, when it must hold, when it is over.

Takes: Poses, buffer states, statuses of the detector, and the time.
Gives: Decisions: a ``TrialStep``, hold or not, and why.
Must not know: ROS and simulators: every decision is a function of what was measured and when.
Begin with: ``trial.py``.
"""
