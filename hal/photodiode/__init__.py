"""Photodiode receivers: I2C converters that are read in uniform blocks, and one that tells dark from dazzled."""
