"""The integrity campaign: random drives of the whole daemon against the truth."""
