"""Deskew, distance region and ICP (Eq. 10-15): a scan against the local map gives a match (T2)."""
