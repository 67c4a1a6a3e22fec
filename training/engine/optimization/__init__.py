"""Optimisers, learning rates over a run, and averaged weights."""
