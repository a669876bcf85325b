"""A dive as ROS 2 messages: definitions, frames of reference, topics, MCAP files; needs no ROS."""
