"""What goes over topics and into recordings: topics, messages, their order; without ROS."""
