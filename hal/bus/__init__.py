"""I2C buses: Linux device node, remote bus over a socket with its server, memory bus for simulation."""
