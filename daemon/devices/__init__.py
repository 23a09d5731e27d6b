"""Devices as the daemon uses them; `conversion` is the only place where device units become SI."""
