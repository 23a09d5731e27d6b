"""`lumiloop lamps`: which lamps are dead, dimming or moved, and by when to replace them.

`history` keeps what the daemon's maps say of each lamp's strength, `judge` draws conclusions, `command` tells a person.
"""
