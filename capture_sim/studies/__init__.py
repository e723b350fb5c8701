"""Studies of many simulated or recorded runs: sweep, design, identification, comparison.

Takes: A ``Scene`` and its varied values; or one or two ``Run`` objects.
Gives: Tables, designs, fits with standard errors, agreements.
Must not know: How results are drawn or written.
Begin with: ``sweep.py``.
"""
