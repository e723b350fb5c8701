"""Kernels: functions that Numba compiles, and what compiles and caches them."""
