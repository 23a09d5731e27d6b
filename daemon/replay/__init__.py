"""Replay of logs and recordings through the daemon's cycle in virtual time, and the results as files."""
