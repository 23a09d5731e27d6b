"""Recorded logs played back as devices: CARMEN, own recordings, raw SCIP captures."""
