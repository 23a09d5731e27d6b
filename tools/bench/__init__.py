"""Benchmarks; they print figures and write them as data, they never judge time in a test."""
