"""The networks of a training recipe: one class a network, told apart by ``name``."""

from abc import ABC, abstractmethod
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator, model_validator

from datagen.recipe import Frozen

DSFFNET, NPT, CORENET3D = "DSFFNet", "NPT", "3D-CoreNet"
"""The three networks, by the paper's names."""
WITHOUT_FUSION, WITHOUT_TARGET_SIDE, WITHOUT_EDGE_LOSS = "w/o FFAdaIN", "w/o side target", "w/o L_edge"
"""The ablations of DSFFNet, by the paper's names (Table 3)."""

Widths = tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
NormWeights = Annotated[
    Literal["uniform", "area"],
    Field(description="how much vertices count in norms: all the same (as published), or by the area around them"),
]


class NetworkSection(Frozen, ABC):
    """Base of the sections of networks."""

    @property
    @abstractmethod
    def title(self) -> str:
        """What tables call the network: the paper's name, with what is left out or differs after it."""

    @property
    def needs_equal_counts(self) -> bool:
        """Whether it pairs source and target by index, so that both must have as many vertices."""
        return False


class DsffnetRecipe(NetworkSection):
    """DSFFNet; the defaults are the paper's (9,371,023 parameters)."""

    name: Literal["dsffnet"] = Field("dsffnet", description="network, see training.networks")
    encoder_widths: Widths = Field((64, 128, 1024), description="channels of the pose encoder's layers")
    decoder_widths: Widths = Field((256, 1024, 256), description="channels of the decoder's three blocks")
    feature_fusion: bool = Field(True, description="false: ablation w/o FFAdaIN (paper, Table 3)")
    target_side: bool = Field(True, description="false: ablation w/o the target side's own branch (paper, Table 3)")
    initial_mixing: float = Field(
        0.0, ge=-1, le=2, description="alpha and beta of every FFAdaIN at first: 0 all target side (paper), 1 all mixed"
    )
    norm_weights: NormWeights = "uniform"

    @model_validator(mode="after")
    def _something_modulates(self) -> "DsffnetRecipe":
        if not (self.feature_fusion or self.target_side):
            raise ValueError(
                "feature_fusion and target_side cannot both be false: nothing would be left to modulate by"
            )
        return self

    @property
    def title(self) -> str:
        if not self.feature_fusion:
            return f"{DSFFNET} {WITHOUT_FUSION}"
        return DSFFNET if self.target_side else f"{DSFFNET} {WITHOUT_TARGET_SIDE}"


class NptRecipe(NetworkSection):
    """The baseline NPT; the defaults are its released code's (6,054,941 parameters)."""

    name: Literal["npt"] = Field("npt", description="network, see training.networks")
    variant: Literal["maxpool", "origin"] = Field(
        "maxpool",
        description="maxpool: one pose vector a mesh; origin: one a vertex, source and target paired by index",
    )
    encoder_widths: Widths = Field((64, 128, 1024), description="channels of the pose encoder; the decoder's follow")
    norm_weights: NormWeights = "uniform"

    @property
    def title(self) -> str:
        return NPT if self.variant == "maxpool" else f"{NPT} {self.variant}"

    @property
    def needs_equal_counts(self) -> bool:
        return self.variant == "origin"


def _with_network_name(values: Any) -> Any:
    """Recipes that name no network mean DSFFNet."""
    return {"name": DEFAULT_NETWORK, **values} if isinstance(values, dict) else values


DEFAULT_NETWORK = "dsffnet"


class CoreNet3dRecipe(NetworkSection):
    """3D-CoreNet; the defaults are the paper's (24,461,447 parameters)."""

    name: Literal["corenet3d"] = "corenet3d"
    feature_widths: Widths = Field((64, 128, 256), description="channels of the vertex features' layers")
    generator_widths: Widths = Field((1024, 512, 256), description="channels of the generator's three blocks")
    centre_features: bool = Field(False, description="centre features over channels before they are compared")
    norm_weights: NormWeights = "uniform"

    @property
    def title(self) -> str:
        return CORENET3D


class PartsRecipe(NetworkSection):
    """The parts network, which learns from datasets with rigs; no paper's."""

    name: Literal["parts"] = "parts"
    joints: dict[str, str | None] = Field(
        default_factory=lambda: dict(PEOPLE),
        description="joints that turn the parts, each with its parent's name; default: SMPL's 24",
    )
    width: int = Field(128, ge=1, description="channels of the vertices' features")
    token_width: int = Field(96, ge=4, multiple_of=4, description="channels of the parts' tokens")
    blocks: int = Field(3, ge=1, description="layers of attention between the parts")

    @field_validator("joints")
    @classmethod
    def _is_a_tree(cls, joints: dict[str, str | None]) -> dict[str, str | None]:
        names = list(joints)
        for place, (name, parent) in enumerate(joints.items()):
            if parent is not None and parent not in names[:place]:
                raise ValueError(f"joint {name!r} comes before its parent {parent!r}, or there is none of that name")
        if not joints:
            raise ValueError("joints names none")
        return joints

    @property
    def title(self) -> str:
        return "Parts (from rigs)"  # its supervision is said wherever its name is


class TemplateRecipe(NetworkSection):
    """FITE's implicit template of an outfit; the defaults are the released sizes (465,708 parameters)."""

    name: Literal["template"] = "template"
    width: int = Field(256, ge=8, description="channels of the hidden layers")
    points: int = Field(5625, ge=8, description="points around each scan that a step takes, others each time")
    hand_points: int = Field(500, ge=1, description="points around the body's hands that a step takes")

    @property
    def title(self) -> str:
        return f"FITE {self.name}"


class AvatarRecipe(NetworkSection):
    """FITE's point avatar; the defaults are the released sizes (9,969,417 parameters beside the points' features)."""

    name: Literal["avatar"] = "avatar"
    map_size: int = Field(256, ge=16, description="pixels across a position map: a power of two")
    unet_width: int = Field(16, ge=1, description="channels after the first level of the pose encoders")
    hidden_width: int = Field(256, ge=1, description="channels of the decoder's hidden layers")
    geometry: int = Field(64, ge=1, description="channels of a point's own features")
    pose: int = Field(64, ge=4, multiple_of=4, description="channels of a point's pose features, over all four views")
    normalisation: Literal["group", "batch"] = Field(
        "group", description="group: nothing depends on batch or ranks; batch: as released"
    )
    features_rate: float = Field(
        1.0, gt=0, description="learning rate of the points' own features, in those of all else (released: 5/3)"
    )
    scan_points: int = Field(20_000, ge=8, description="points of each scan that a step takes, others each time")
    normals_from: float = Field(
        0.625, ge=0, le=1, description="share of the training after which normals count (released: 250 of 401 epochs)"
    )
    roughness: float = Field(
        100.0,
        ge=0,
        description="weight of metres between a point's offset and the mean of its neighbours'; 0: as released",
    )

    def sizes(self) -> dict[str, Any]:
        """Those of the network; the rest says how it is trained."""
        return self.model_dump(exclude={"name", "features_rate", "scan_points", "normals_from", "roughness"})

    @property
    def title(self) -> str:
        return f"FITE {self.name}"

    @field_validator("map_size")
    @classmethod
    def _halves_to_two(cls, size: int) -> int:
        if size & (size - 1):
            raise ValueError(f"map_size must be a power of two, got {size}")
        return size


PEOPLE: dict[str, str | None] = {
    "pelvis": None,
    "left_hip": "pelvis", "right_hip": "pelvis", "spine1": "pelvis",
    "left_knee": "left_hip", "right_knee": "right_hip", "spine2": "spine1",
    "left_ankle": "left_knee", "right_ankle": "right_knee", "spine3": "spine2",
    "left_foot": "left_ankle", "right_foot": "right_ankle", "neck": "spine3",
    "left_collar": "spine3", "right_collar": "spine3", "head": "neck",
    "left_shoulder": "left_collar", "right_shoulder": "right_collar",
    "left_elbow": "left_shoulder", "right_elbow": "right_shoulder",
    "left_wrist": "left_elbow", "right_wrist": "right_elbow",
    "left_hand": "left_wrist", "right_hand": "right_wrist",
}  # fmt: skip
"""SMPL's joints and their parents."""

NETWORK_NAMES = ("dsffnet", "npt", "corenet3d", "parts")

NetworkRecipe = Annotated[
    Annotated[
        DsffnetRecipe | NptRecipe | CoreNet3dRecipe | PartsRecipe | TemplateRecipe | AvatarRecipe,
        Field(discriminator="name"),
    ],
    BeforeValidator(_with_network_name),
]
"""The network of a training: one class a network, told apart by ``name``."""
