"""Recipe sections of the bodies: one class a family, told apart by ``family``."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from datagen.recipe.anny import AnnyBody
from datagen.recipe.base import BodySection
from datagen.recipe.clothed import ClothedBody


class LegBody(BodySection):
    """A procedural two-bone leg: no assets, milliseconds to load; for tests and for trying the pipeline out."""

    family: Literal["leg"] = "leg"
    rings: int = Field(24, ge=4, description="rings of vertices from hip to foot")
    segments: int = Field(12, ge=3, description="vertices on each ring")

    @property
    def expected_vertices(self) -> float:
        return self.rings * self.segments


class SmplBody(BodySection):
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


class SmalBody(BodySection):
    """SMAL animals (33 to 35 joints, 41 betas) from a model file of the user's in SMPL's layout."""

    family: Literal["smal"] = "smal"
    path: str | None = Field(None, description="model file or folder; without it the folder in DSFFNET_BODY_MODELS")
    families: str | None = Field(
        None, description="SMAL's data file with cluster_means; identities are then drawn around the families' means"
    )
    betas: int = Field(41, ge=1, le=400, description="shape parameters in use")
    beta_range: float = Field(1.0, gt=0, description="shape parameters are uniform within +- this (about the mean)")


class RiggedBody(BodySection):
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
    vertices: int | None = Field(
        None, ge=50, description="simplify each character to about so many vertices; default: all, as in the file"
    )

    @property
    def expected_vertices(self) -> float | None:
        return self.vertices


Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


class ImportedBody(BodySection):
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
    AnnyBody | SmplBody | SmalBody | RiggedBody | ImportedBody | ClothedBody | LegBody, Field(discriminator="family")
]


class MixedBody(BodySection):
    """Several bodies in one dataset: identity i is of body i modulo their number; all take the same poses."""

    family: Literal["mixed"] = "mixed"
    bodies: tuple[SingleBody, ...] = Field((AnnyBody(),), min_length=1, description="the bodies, in order")

    @property
    def expected_vertices(self) -> float | None:
        counts = [body.expected_vertices for body in self.bodies]
        known = [count for count in counts if count is not None]
        return sum(known) / len(known) if len(known) == len(counts) else None

    @property
    def seconds_a_mesh(self) -> float:
        return sum(body.seconds_a_mesh for body in self.bodies) / len(self.bodies)

    @property
    def worker_bytes(self) -> float:
        return sum(body.worker_bytes for body in self.bodies)


Body = Annotated[
    AnnyBody | SmplBody | SmalBody | RiggedBody | ImportedBody | ClothedBody | LegBody | MixedBody,
    Field(discriminator="family"),
]
