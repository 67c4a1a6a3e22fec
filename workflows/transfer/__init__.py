"""Posing a person's own mesh files."""
