"""Logs and recordings through the daemon's own cycle on a virtual clock."""
