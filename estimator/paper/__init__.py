"""The paper's method as printed, and pIC: baselines that can be run by name."""
