"""Setting up a building: lamp planning before, calibration and survey by drive after the lamps hang."""
