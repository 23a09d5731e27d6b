"""The published state of the localisation, and the monitors it is based on."""
