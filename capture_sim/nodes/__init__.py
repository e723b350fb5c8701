"""The ROS 2 nodes, one program a file; no other room knows ROS.

Takes: Parameters and messages.
Gives: Messages, and one call into the core for each.
Must not know: Physics and rules: they are in the rooms below.
Begin with: ``simulator.py``.

``base`` is what every node is made of, ``protocol`` how nodes agree on a run, ``simulation`` what
simulator and player do, ``trials`` how trials of a real bench are run.
"""
