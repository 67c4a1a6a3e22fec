"""A person in clothes as tasks of the trainer: the template of an outfit, and the point avatar (FITE)."""
