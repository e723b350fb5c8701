"""A trial of a real bench: when it may release, when it must hold, and when it is over.

Takes: Poses, buffer states, statuses of the detector, and the time.
Gives: Decisions: the ``TrialStep`` values to do, whether to hold, and the reason.
Must not know: ROS and simulators: every decision depends only on measurements and their times.
Begin with: ``trial.py``.
"""
