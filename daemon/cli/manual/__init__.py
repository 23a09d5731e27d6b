"""Help of the command line: groups and examples, suggestions, completion of shells, man pages."""
