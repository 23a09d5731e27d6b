"""Relocalisation, kidnap detection and pose hypotheses: the robot's pose in a stored map without a prediction."""
