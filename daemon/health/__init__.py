"""Faults and reasons with their texts, and the assessment of the process and its parts."""
