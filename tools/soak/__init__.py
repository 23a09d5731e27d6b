"""Runs for hours or simulated weeks, and whether anything grows: memory, files, threads, time."""
