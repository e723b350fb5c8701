"""A trial of a real bench, without ROS."""
