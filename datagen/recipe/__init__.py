"""The typed recipe of a dataset: its body, its poses, its sizes."""

from datagen.recipe.anny import AnnyBody, AnnyRig, AnnyTopology, PhenotypeRanges
from datagen.recipe.base import Frozen, Range
from datagen.recipe.bodies import (
    Axis,
    Body,
    ImportedBody,
    LegBody,
    MixedBody,
    RiggedBody,
    SingleBody,
    SmalBody,
    SmplBody,
)
from datagen.recipe.clothed import OUTFITS, PART_KINDS, ClothedBody, DrapeSolver, GarmentFile, GarmentPart, OwnOutfit
from datagen.recipe.dataset import (
    ANIMALS,
    PATH_KEYS,
    DatasetRecipe,
    EvaluationTriples,
    Growth,
    IdentityRecipe,
    PoseRecipe,
    StoreRecipe,
    plain_sha256,
)
from datagen.recipe.poses import AmassPoses, ClipPoses, Distribution, FilePoses, FoundPoses, NptPoses, RangePoses

__all__ = [
    "ANIMALS",
    "OUTFITS",
    "PART_KINDS",
    "PATH_KEYS",
    "AmassPoses",
    "AnnyBody",
    "AnnyRig",
    "AnnyTopology",
    "Axis",
    "Body",
    "ClipPoses",
    "ClothedBody",
    "DatasetRecipe",
    "Distribution",
    "DrapeSolver",
    "EvaluationTriples",
    "FilePoses",
    "FoundPoses",
    "Frozen",
    "GarmentFile",
    "GarmentPart",
    "Growth",
    "IdentityRecipe",
    "ImportedBody",
    "LegBody",
    "MixedBody",
    "NptPoses",
    "OwnOutfit",
    "PhenotypeRanges",
    "PoseRecipe",
    "Range",
    "RangePoses",
    "RiggedBody",
    "SingleBody",
    "SmalBody",
    "SmplBody",
    "StoreRecipe",
    "plain_sha256",
]
