"""A tap that serves the live stream to Foxglove as ROS messages."""
