"""Recordings, flight recorder and checkpoints."""
