"""Checkpoints on disk: atomic, hashed, exported."""
