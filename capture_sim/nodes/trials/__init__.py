"""How a trial of a real bench is run over ROS: an action, the bench's topics, launcher/hold.

Takes: Goals of the action, measurements, statuses.
Gives: Commands to the rig, and the trial's result.
Must not know: Simulators.
Begin with: ``server.py``.
"""
