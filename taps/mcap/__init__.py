"""MCAP files of ROS 2 messages: live recording, export of recordings, recovery of truncated files.

``export`` and ``recover`` are commands, but stay in this room: they need the ROS 2 messages of :mod:`taps.ros`, and the
daemon imports no tap.
"""
