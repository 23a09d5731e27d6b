"""Files that a person writes: the configuration, the light survey and residual maps."""
