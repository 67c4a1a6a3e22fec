"""Triples in their order, batches, meshes kept in memory or streamed."""
