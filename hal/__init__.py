"""Devices: bytes on a wire to device units with arrival times. Knows nothing of maps, poses or configuration files."""
