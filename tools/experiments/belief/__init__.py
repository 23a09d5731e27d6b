"""What the belief in the place is worth: real drives, spoiled ones, sensors that lie, constants."""
