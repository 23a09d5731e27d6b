"""The lit ceiling at link level: lamps, walls that reflect, what moves in between."""
