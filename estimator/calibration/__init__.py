"""Off-line calibration from recorded drives: lamps, receiver, odometry, lidar mount."""
