"""`lumiloop doctor`: what is wrong with this installation, and what to do about it first.

`host` asks the computer and the running daemon; `checks` judges what they say; `report` tells a person.
"""
