"""The verbs of ``lumiloop map``."""
