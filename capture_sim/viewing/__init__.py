"""What is looked at: plots, a report, rerun recordings and live views.

Takes: A ``Run`` or several, results of studies.
Gives: Figures, HTML, rerun recordings.
Must not know: Where a run comes from.
Begin with: ``figures.py``.
"""
