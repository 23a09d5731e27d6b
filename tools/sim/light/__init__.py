"""Coded light at waveform level, and devices and drives under it."""
