"""Parameters of a bench from its trials, with errors that are true, and what they predict.

Takes: Runs of one bench, the names of its parameters, and what was weighed.
Gives: A ``Calibration``: values, covariance, tests of both, and a scene that predicts.
Must not know: How results are drawn, printed or written on the command line.
Begin with: ``calibrate.py``; the search is ``descent.py``, a trial's model ``trial.py``.
"""
