"""User-edited files: the configuration, the lamp survey, and residual maps."""
