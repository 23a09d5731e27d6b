"""ROS 2 messages of the stream, and a ROS 2 node without ROS."""
