"""Faults and reasons with their texts, and the health of the process and its components."""
