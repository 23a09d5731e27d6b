"""`make demo`: the daemon on a simulated robot under coded lamps."""
