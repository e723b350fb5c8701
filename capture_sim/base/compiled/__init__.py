"""Compilation of functions with Numba; results are kept on disk, named by a hash of the code.

Takes: Python functions with a decorator of ``kernels.py``.
Gives: The same functions, compiled at their first call.
Must not know: What the functions compute.
Begin with: ``kernels.py``.
"""
