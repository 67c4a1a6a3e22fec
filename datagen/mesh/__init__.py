"""Meshes: geometry, files, sequences of files, limits."""
