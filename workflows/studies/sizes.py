"""What a study of generalisation makes, and how much of it."""

from dataclasses import dataclass
from typing import Literal

from datagen.recipe import AnnyTopology

Other = Literal["smpl", "animals"]
TOPOLOGIES: tuple[AnnyTopology, ...] = (
    "notoes_collapse3pc", "notoes_collapse5pc", "notoes_collapse10pc", "notoes", "anny", "soma",
)  # fmt: skip
"""From 369 to 18,056 vertices."""
OTHERS: tuple[Other, ...] = ("smpl", "animals")


@dataclass(frozen=True)
class Sizes:
    """How much of each kind is made, and the seed of its draws (another than the training's)."""

    identities: int = 4
    poses: int = 8
    triples: int = 16
    seed: int = 1000
