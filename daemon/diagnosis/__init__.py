"""What is wrong with an installation, and why a recorded moment was as it was."""
