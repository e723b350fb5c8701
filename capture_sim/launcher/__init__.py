"""The launcher's state machine, which compares a running launch with its plan.

Takes: A ``Scene`` and a ``LaunchObservation`` at a time.
Gives: ``LauncherStatus``.
Must not know: Where an observation comes from: a simulator, poses of a rig, a replay.
Begin with: ``state_machine.py``.
"""
