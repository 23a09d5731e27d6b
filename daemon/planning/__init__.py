"""`lumiloop plan`: where to hang how many lamps over a floor, and how well a robot will know its place there.

`hall` reads the floor plan, `sight` says which place sees which lamp and what it learns of it, `walls` what the laser
learns, `choose` where lamps go, `command` and `picture` tell a person.
"""
