"""Many runs, or recorded ones: sweep, design, identification, comparison.

Takes: A ``Scene`` and what varies; or a ``Run`` or two.
Gives: Tables, designs, fits with standard errors, agreements.
Must not know: How results are drawn or written.
Begin with: ``sweep.py``.
"""
