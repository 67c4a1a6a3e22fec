"""Pose transfer as a task of the trainer: batches of triples, the networks' losses, PMD."""
