"""MCAP files: live recording, conversion of recordings, recovery of cut files."""
