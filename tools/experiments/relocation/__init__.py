"""Robots switched on or carried away in a mapped building."""
