"""What goes into the emulated computer, besides the package."""
