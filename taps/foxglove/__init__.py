"""A live Foxglove server of the stream's ROS 2 messages."""
