"""All that is known of one run, whatever it comes from.

Takes: A ``Scene`` to simulate, or series of measurements.
Gives: A ``Run``: samples, series, touches, events, loads, verdict, summary.
Must not know: Files, messages, plots: they accept a ``Run``.
Begin with: ``run.py``.
"""
