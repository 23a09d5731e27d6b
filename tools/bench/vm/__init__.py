"""The virtual bench: the shipped package under a real kernel and service manager, in an emulated computer."""
