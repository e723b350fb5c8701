"""Pace, pause, step and reset, of the simulator and of a player; without ROS."""
