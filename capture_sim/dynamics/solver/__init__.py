"""Runge-Kutta steps and root finding for any right-hand side; nothing here knows of vehicles."""
