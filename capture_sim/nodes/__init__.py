"""ROS 2 nodes: thin adapters that convert messages and make one call into the core."""
