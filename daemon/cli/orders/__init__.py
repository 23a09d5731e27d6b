"""Commands that give an order to a running daemon, and wait for its result."""
