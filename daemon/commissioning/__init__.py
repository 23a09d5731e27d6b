"""Commissioning of a building: lamp planning before installation; calibration and survey by a drive after it."""
