"""All data and results of one run, from any source.

Takes: A ``Scene`` to simulate, or series of measurements.
Gives: A ``Run``: samples, series, touches, events, loads, verdict, summary.
Must not know: Files, messages, plots: they accept a ``Run``.
Begin with: ``run.py``.
"""
