"""Numbers only: SI arrays in, poses with their uncertainty out. No operating system, no devices, no clock."""
