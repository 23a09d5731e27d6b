"""Benchmarks of the whole daemon as a process."""
