"""The robot: its drive along a route, its odometry, and hands that carry it."""
