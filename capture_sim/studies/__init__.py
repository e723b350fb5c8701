"""Studies of many simulated or recorded runs: sweep, design, calibration, comparison.

Takes: A ``Scene`` and its varied values; or one or more ``Run`` objects.
Gives: Tables, designs, fits with standard errors, agreements.
Must not know: How results are drawn or written.
Begin with: ``evaluate/sweep.py``; below it ``vary``, above it ``search`` and ``fit``.
"""
