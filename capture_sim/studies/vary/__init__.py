"""What a study varies: numbers of a scene by name, with values, ranges or distributions.

Takes: A ``Scene``, names, and texts or values.
Gives: ``Input``s with their values or scales, and the samples of a sweep.
Must not know: What runs, or what comes out.
Begin with: ``inputs.py``.
"""
