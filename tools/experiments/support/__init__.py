"""What the experiments share: reports, trajectories, drives."""
