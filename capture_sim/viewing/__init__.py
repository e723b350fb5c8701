"""Views of runs and studies: plots, an HTML report, rerun recordings and live views.

Takes: A ``Run`` or several, results of studies.
Gives: Figures, HTML, rerun recordings.
Must not know: Where a run comes from.
Begin with: ``figures.py``.
"""
