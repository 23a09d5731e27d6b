"""The simulated building: walls, robot, lidar beams."""
