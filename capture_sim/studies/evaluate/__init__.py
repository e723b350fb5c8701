"""Evaluation of rows of inputs on one or many cores: sweeps, capture ranges, probabilities.

Takes: A ``Scene`` and rows of its inputs.
Gives: Outcomes with what happened, loads, tables; never the requirements.
Must not know: How the rows were chosen.
Begin with: ``sweep.py``.
"""
