"""Bodies of the commands on lamps that need no recorded drive: their history, and their codes."""
