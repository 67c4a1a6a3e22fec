"""Studies of trained weights."""
