"""The recipe of an avatar: the scans, the field, the templates, the points, and what is measured."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from pydantic import Field, model_validator

from datagen.common.errors import RecipeError
from datagen.recipe import ClothedBody, DatasetRecipe, Frozen
from datagen.recipe.text import changed, parse_words, read_values, require_plain
from training.recipes.networks import AvatarRecipe, TemplateRecipe
from training.recipes.training import TrainingRecipe
from workflows.pipeline.ray_cluster import require_reachable
from workflows.recipe.loader import recipe_faults, with_absolute_paths
from workflows.recipe.names import file_of, known_files


class FieldRecipe(Frozen):
    """The grid of diffused skinning weights around the body."""

    centres: int = Field(1500, ge=16, le=5000, description="points of the skin that the spline goes through")
    spacing: float = Field(0.03, ge=0.004, le=0.2, description="metres between the grid's cells")
    margin: float = Field(
        0.25, ge=0.01, le=1, description="metres around the body that the grid covers; skirts stand out by 0.2"
    )


class ScanRecipe(Frozen):
    """What is drawn of each scan, once."""

    around: int = Field(5000, ge=64, description="points around each scan that templates learn from")
    surface: int = Field(40_000, ge=64, description="points of each scan's surface that the avatar learns from")


class AvatarEvaluation(Frozen):
    """What is measured and drawn."""

    frames: int = Field(8, ge=1, description="poses of each kind (seen, unseen) and outfit")
    samples: int = Field(20_000, ge=100, description="of the surfaces of scan and avatar")
    examples: int = Field(3, ge=1, description="unseen poses of each outfit in the picture")


class AvatarWorkflow(Frozen):
    """Everything that ``dsffnet avatar train`` does."""

    description: str = Field("", description="one line for people")
    data: DatasetRecipe | None = Field(
        None, description="scans: people of family clothed; those of the evaluation split are taken"
    )
    people: tuple[str, ...] = Field(
        (), description="in the place of data: files of one's own scans, one a person in an outfit (docs/avatar.md)"
    )
    field: FieldRecipe = Field(default_factory=FieldRecipe)
    scans: ScanRecipe = Field(default_factory=ScanRecipe)
    template: TrainingRecipe = Field(description="of each outfit's implicit template")
    cell: float = Field(0.015, ge=0.003, le=0.1, description="metres between the points of a template")
    avatar: TrainingRecipe = Field(description="of the points of all outfits")
    evaluation: AvatarEvaluation = Field(default_factory=AvatarEvaluation)

    @model_validator(mode="after")
    def _can_be_learned(self) -> Self:
        if self.data is None or self.people:
            self._require_people()
        elif not isinstance(self.data.body, ClothedBody):
            raise ValueError(
                f"data.body.family: an avatar is learned of dressed people, not of {self.data.body.family!r}; use "
                "clothed"
            )
        elif self.data.identities.evaluation == 0:
            raise ValueError(
                "data.identities.evaluation is 0, but these are the people who become avatars: set it to 1 or more"
            )
        for section, training, kind in (
            ("template", self.template, TemplateRecipe),
            ("avatar", self.avatar, AvatarRecipe),
        ):
            if not isinstance(training.network, kind):
                raise ValueError(f"{section}.network: need {section!r}, not {training.network.name!r}")
        return self

    def _require_people(self) -> None:
        if (self.data is None) != bool(self.people):
            raise ValueError("data, people: need one of the two, scans that are made or files of one's own")
        names = [Path(path).stem for path in self.people]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"people: two files are called {twice[0]!r}, which is the name of the outfit; rename one")
        strange = [name for name in names if not re.fullmatch(r"\w[\w .-]*", name)]
        if strange:
            raise ValueError(
                f"people: {strange[0]!r} becomes the name of an outfit and of folders; let it begin with a letter or "
                "digit, and hold only letters, digits, blanks and . _ -"
            )


def known_avatars() -> dict[str, Path]:
    """Avatars' recipes that come with the project, by name."""
    return known_files("avatars")


def load_avatar(
    name_or_file: str, overrides: Sequence[str] = (), *, people: Sequence[str | Path] = ()
) -> AvatarWorkflow:
    """Read a recipe by name or file, apply overrides ``section.key=value``, and check all of it.

    ``people``: files of scans that take the place of the recipe's data.

    Raises
    ------
    RecipeError
        No such recipe, not YAML, an unknown key, or a value that cannot be.
    """
    path = file_of(name_or_file, known_avatars(), what="avatar")
    values: Any = read_values(path)
    require_plain(values, where=f"recipe {name_or_file}")
    if not isinstance(values, dict):
        raise RecipeError(f"recipe {name_or_file} is not a mapping of sections (data, field, scans, template, avatar)")
    words = parse_words(overrides, option="--set ")
    values = with_absolute_paths(changed(values, words), path.resolve().parent)
    if people:
        without = [word for word in overrides if word.startswith(("data", "people"))]
        if without:
            raise RecipeError(f"--set {without[0]} has no effect beside --people: take one of the two away")
        values = {**values, "data": None, "people": [str(each) for each in people]}
    if isinstance(values.get("people"), list):
        folder = Path.cwd() if people else path.resolve().parent
        values["people"] = [require_reachable(str(folder / str(its)), option="--people") for its in values["people"]]
    with recipe_faults(name_or_file, model=AvatarWorkflow, keys="dsffnet avatar train --help-all"):
        return AvatarWorkflow.model_validate(values)
