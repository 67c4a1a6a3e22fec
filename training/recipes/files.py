"""Reading a training recipe from a file and words KEY=VALUE, without Ray and MLflow."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from datagen.common.errors import RecipeError
from datagen.recipe.text import changed, faults_text, parse_words, read_values
from training.recipes.networks import DEFAULT_NETWORK
from training.recipes.training import TrainingRecipe


def recipe_in(path: Path, words: Sequence[str] = ()) -> TrainingRecipe:
    """The training recipe in a file, with changes.

    Parameters
    ----------
    path
        YAML, or JSON by its ending: a training section, or a whole recipe (as ``dsffnet recipe``
        prints it), of which the section ``training`` is taken.
    words
        ``budget=9min``, ``network.name=npt``, ``training.steps=100``, see :func:`datagen.recipe.text.parse_words`.

    Raises
    ------
    RecipeError
        It cannot be read, or some of it is no training recipe; each fault with its key.
    """
    changes = [(key.removeprefix("training."), value) for key, value in parse_words(words)]
    values = changed(_section(read_values(path), path), changes, kinds=[("network", "name", DEFAULT_NETWORK)])
    try:
        return TrainingRecipe.model_validate(values)
    except ValidationError as error:
        raise RecipeError(f"{path} is no training recipe: {faults_text(error)}") from error


def _section(values: Any, path: Path) -> dict[str, Any]:
    section = values["training"] if isinstance(values, dict) and "training" in values else values
    if isinstance(section, str):
        raise RecipeError(
            f"{path} names the training recipe {section!r}, which only dsffnet resolves. Write it out: "
            f"dsffnet recipe --recipe {path} > resolved.yaml"
        )
    if not isinstance(section, dict):
        raise RecipeError(f"{path} is no training recipe: it holds {type(values).__name__}, not keys with values")
    return dict(section)
