"""Recipe sections of the poses' sources: one class a source, told apart by ``name``."""

from typing import Annotated, Literal

from pydantic import Field

from datagen.recipe.base import Frozen, Range


class NptPoses(Frozen):
    """Uniform joint ranges of Neural Pose Transfer's generator, over SMPL's 24 joints."""

    name: Literal["npt"] = "npt"
    arrangement: Literal["mixed", "published"] = Field(
        "mixed",
        description="mixed: both NPT families (bent, straight) in seen and unseen alike; "
        "published: the first half of all poses bent, the second straight",
    )


class AnatomicalPoses(Frozen):
    """People's whole range of motion: bent trunks, turned heads, a quarter of arms and legs folded tightly."""

    name: Literal["anatomical"] = "anatomical"
    npt: float = Field(0.0, ge=0, le=1, description="share of the poses, by chance, that are drawn as npt's are")


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
    NptPoses | AnatomicalPoses | RangePoses | ClipPoses | AmassPoses | FilePoses | FoundPoses,
    Field(discriminator="name"),
]
