"""Engines that run the benchmark's scene: ours, SciPy's integrators, Exudyn, MuJoCo, Drake."""
