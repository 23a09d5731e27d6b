"""I2C buses: Linux device node, remote bus, memory bus."""
