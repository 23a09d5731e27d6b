"""Experiments: what the estimators reach in simulated rooms and on public recordings, as tables, data and pictures."""
