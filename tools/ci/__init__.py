"""Checks of the repository: coverage floors, contracts, figures as data, the tests of a change."""
