"""Recorded logs read and played back as devices: CARMEN logs, lumiloop recordings, raw SCIP captures."""
