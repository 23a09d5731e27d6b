"""ROS 2: the stream as ROS 2 messages, and a node over Zenoh without a ROS installation."""
