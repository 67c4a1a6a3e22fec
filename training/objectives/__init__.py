"""Losses and metrics."""

PMD_UNIT = 1e-4
"""Tables and figures give PMD (:func:`training.objectives.metrics.point_mesh_distance`) in units of this."""
