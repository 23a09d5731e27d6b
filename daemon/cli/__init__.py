"""The `lumiloop` command: one module for each command."""
