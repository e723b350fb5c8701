"""From measurements, or exact samples, to a verdict.

Takes: Poses and buffer states with stamps (``Measurement``), or samples of dtype SAMPLE.
Gives: ``CaptureStatus``, the last one with the verdict.
Must not know: Messages and ROS, a simulator's events, forces.
Begin with: ``criteria.py``.
"""
