"""Kinematics, forces and energies of the bench, as pure compiled functions."""
