"""The trainer: step, optimizer, validation, ranks, resume."""
