"""Sockets: addresses, receive timestamps, odometry and IMU datagrams, and a limit on the time spent on them."""
