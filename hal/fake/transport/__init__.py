"""What carries the bytes of the fake lidar: a pseudo-terminal, a TCP server, a memory port."""
