"""Fit of a bench's parameters to its trials, with standard errors, tests, and predictions.

Takes: Runs of one bench, the names of its parameters, and values that were weighed.
Gives: A ``Calibration``: values, covariance, tests of both, and a scene with the values.
Must not know: How results are drawn, printed or written on the command line.
Begin with: ``calibrate.py``; the search is ``descent.py``, a trial's model ``trial.py``.
"""
