"""The light receiver: I2C converters read in uniform sample blocks, and a DC channel for the mean light level."""
