"""Motion model and published pose (Eq. 14-15): combines prediction, scan match and light solution (Tk)."""
