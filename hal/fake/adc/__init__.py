"""Simulated I2C converters and their bus, exact byte for byte, with fault injection."""
