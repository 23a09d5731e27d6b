"""Where in the stored map the robot is, while that is in doubt."""
