"""Keyframes, submaps, loop closure and pose graph (Sect. 4.3)."""
