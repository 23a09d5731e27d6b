"""Diagnosis: checks of an installation, ageing of lamps, and reports on a recorded moment."""
