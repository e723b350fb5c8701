"""The loop through contact hardware: vehicles and buffer simulated, the contact measured.

Takes: A ``Scene``, wrenches of a rig.
Gives: Positions for the rig, a report, and a ``Run`` after the end.
Must not know: ROS: a node carries positions and wrenches.
Begin with: ``loop.py``.
"""
