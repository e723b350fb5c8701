"""How trials of a real bench are run over ROS."""
