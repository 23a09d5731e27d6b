"""Fault orders for fake devices: read from TOML, put in force over time, given live over a socket."""
