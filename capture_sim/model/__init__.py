"""How the bench moves: kinematics, forces and energies, as pure compiled functions."""
