"""The capture detector: it derives a verdict from measurements or exact samples.

Takes: Poses and buffer states with stamps (``Measurement``), or samples of dtype SAMPLE.
Gives: ``CaptureStatus`` objects, the last of which has the verdict.
Must not know: Messages and ROS, a simulator's events, forces.
Begin with: ``criteria.py``.
"""
