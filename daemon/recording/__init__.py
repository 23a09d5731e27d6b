"""Recordings of a run, the flight recorder, and checkpoints that a replay starts from."""
