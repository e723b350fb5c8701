"""Functions that Numba compiles, kept on disk by a hash of all their sources.

Takes: Python functions with a decorator of ``kernels.py``.
Gives: The same functions, compiled at their first call.
Must not know: What the functions compute.
Begin with: ``kernels.py``.
"""
