"""Comparison of two runs: the frame of the cameras, their differences, and whether they agree.

Takes: Two ``Run`` objects.
Gives: Differences and agreements by series, frames of recordings.
Must not know: How results are drawn, printed or written.
Begin with: ``compare.py``.
"""
