"""The typed recipe of a dataset: body, identities, poses, evaluation triples, store.

A recipe says everything that the bytes of a dataset depend on. It is frozen, refuses unknown keys, and is
written whole into the dataset's attributes, so that a dataset can be made again from itself.
"""

import hashlib
import json
from typing import Any, Literal

from pydantic import Field, model_validator

from datagen.recipe.anny import AnnyBody
from datagen.recipe.base import Frozen
from datagen.recipe.bodies import Body
from datagen.recipe.poses import Distribution, NptPoses


class IdentityRecipe(Frozen):
    """How many identities, and the seed that they are drawn from (identity i is a function of seed and i alone)."""

    training: int = Field(16, ge=0, description="identities that the network is trained on")
    evaluation: int = Field(8, ge=0, description="new identities that it is evaluated on")
    seed: int = Field(0, ge=0, description="seed of the identity draws")


class PoseRecipe(Frozen):
    """How many poses, from which distribution, and the seed (pose p is a function of seed and p alone)."""

    seen: int = Field(400, ge=1, description="poses that occur in training")
    unseen: int = Field(400, ge=0, description="poses kept for evaluation")
    distribution: Distribution = Field(default_factory=NptPoses, description="where poses come from")
    seed: int = Field(0, ge=0, description="seed of the pose draws")


class EvaluationTriples(Frozen):
    """The fixed lists of evaluation triples that are stored with the dataset."""

    count: int = Field(400, ge=0, description="triples for each pose type (seen, unseen)")
    seed: int = Field(0, ge=0, description="seed of the triples")


class StoreRecipe(Frozen):
    """Layout of the store."""

    poses_per_shard: int = Field(100, ge=1, description="meshes in one shard file; a task writes one or several")
    codec: Literal["lz4", "zstd"] = Field("lz4", description="compressor inside Blosc, after byte shuffle")
    compression_level: int = Field(5, ge=1, le=9, description="level of the compressor")


class Growth(Frozen):
    """What was appended to a dataset, in one step, after what it held before."""

    training: int = Field(0, ge=0, description="more training identities")
    evaluation: int = Field(0, ge=0, description="more evaluation identities")
    seen: int = Field(0, ge=0, description="more seen poses")
    unseen: int = Field(0, ge=0, description="more unseen poses")


class DatasetRecipe(Frozen):
    """Everything that the bytes of a dataset depend on."""

    body: Body = Field(default_factory=AnnyBody, description="body model")
    identities: IdentityRecipe = Field(default_factory=IdentityRecipe)
    poses: PoseRecipe = Field(default_factory=PoseRecipe)
    triples: EvaluationTriples = Field(default_factory=EvaluationTriples)
    store: StoreRecipe = Field(default_factory=StoreRecipe)
    growth: tuple[Growth, ...] = Field((), description="what `dsffnet append` added, step by step")

    @model_validator(mode="after")
    def _holds_something(self) -> "DatasetRecipe":
        if not self.identities.training + self.identities.evaluation:
            raise ValueError("identities: training and evaluation are both 0, so there would be no meshes")
        return self

    def identifying(self) -> dict[str, Any]:
        """The recipe as plain data, without the paths of asset files: where a file lies does not change its bytes.

        What those files hold does; their hashes are compared apart (:class:`datagen.bodies.Asset`). Keys that came
        later than datasets are left out where they mean what those were made by.
        """
        return _without_paths(self.model_dump(mode="json"))

    def sha256(self) -> str:
        """Hash of the identifying recipe in canonical JSON; with the same assets it means the same bytes."""
        return plain_sha256(self.model_dump(mode="json"))


def plain_sha256(values: Any) -> str:
    """The same hash of a recipe that is plain data, as a dataset's attributes have it."""
    canonical = json.dumps(_without_paths(values), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


PATH_KEYS = frozenset({"path", "families", "test_list"})
"""Keys of a recipe that name files; where these lie is not part of a dataset\'s identity."""

ANIMALS = "animals"
"""In the place of a path: the twelve CC0 animals."""


_LATER = [("vertices", None)]
"""Keys younger than some datasets, with the value that stands for how those were made."""


def _without_paths(value: Any) -> Any:
    if isinstance(value, dict):
        kept = {key: inner for key, inner in value.items() if key not in PATH_KEYS and (key, inner) not in _LATER}
        return {key: _without_paths(inner) for key, inner in kept.items()}
    return [_without_paths(inner) for inner in value] if isinstance(value, list) else value
