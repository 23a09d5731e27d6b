"""Robots of a fleet, over Zenoh: what each tells, all on one map, and a survey and a map that all of them share."""
