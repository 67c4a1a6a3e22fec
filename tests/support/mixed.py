"""A dataset whose identities differ in vertex count and topology."""

from datagen.recipe import DatasetRecipe
from tests.support.recipes import tiny_dataset

MIXED_COUNTS = (32, 30, 30)
"""Vertices of identities 0, 1, 2, then again; the last two have equal counts and different faces."""


def mixed_dataset() -> DatasetRecipe:
    """Five training and three evaluation legs of three kinds."""
    kinds = [(8, 4), (6, 5), (10, 3)]
    bodies = [{"family": "leg", "rings": rings, "segments": segments} for rings, segments in kinds]
    return tiny_dataset(body={"family": "mixed", "bodies": bodies}, identities={"training": 5, "evaluation": 3})
