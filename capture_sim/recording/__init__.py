"""Recording of runs as MCAP files, and reading them back; needs no ROS."""
