"""Integrators and root finding; knows nothing of vehicles."""
