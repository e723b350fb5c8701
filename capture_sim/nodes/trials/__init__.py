"""Trials of a real bench over ROS: their action, the bench's topics, the output launcher/hold.

Takes: Goals of the action, measurements, statuses.
Gives: Commands to the rig, and the trial's result.
Must not know: Simulators.
Begin with: ``server.py``.
"""
