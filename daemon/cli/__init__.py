"""Bodies of the `lumiloop` commands: one module for each command, and the parser of the command line."""
