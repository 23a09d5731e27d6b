"""Client of the daemon's local stream and the typed messages on it."""
