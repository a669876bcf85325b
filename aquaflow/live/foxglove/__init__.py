"""A running dive as ROS 2 messages, for Foxglove and for nodes of ROS 2."""
