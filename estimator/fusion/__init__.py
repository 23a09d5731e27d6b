"""Motion model and published pose (Eq. 14-15): prediction, match and light combined (Tk)."""
