"""A bench computer that plays the world for a robot computer under test."""
