"""Sockets: addresses, receive timestamps, odometry and IMU datagrams."""
