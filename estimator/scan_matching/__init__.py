"""Deskew, distance region and ICP (Eq. 10-15): registration of a scan to the local map (T2)."""
