"""The recipes and training recipes that come with the project, by name."""

from pathlib import Path
from typing import Any

from datagen.common.errors import RecipeError
from datagen.common.printable import nearest
from datagen.recipe.text import read_values

_FOLDER = Path(__file__).parents[1] / "recipes"


def known_files(kind: str = "") -> dict[str, Path]:
    """Files that come with the project, by name: of whole recipes, or those in the folder of a ``kind``."""
    return {path.stem: path for path in sorted((_FOLDER / kind).glob("*.yaml"))}


def known_recipes() -> dict[str, Path]:
    """Files of whole recipes, by name."""
    return dict(sorted((known_files() | known_files("clothed") | known_files("papers") | known_files("parts")).items()))


def known_trainings() -> dict[str, Path]:
    """Files of published training recipes, by name: ``training: NAME`` means what one says in that section."""
    return known_files("training")


def file_of(name_or_file: str, known: dict[str, Path], *, what: str) -> Path:
    """The known file of that name, or the YAML file itself.

    Raises
    ------
    RecipeError
        There is none of that name, and it is no name of a YAML file; the nearest and all others are named.
    """
    path = known.get(name_or_file, Path(name_or_file))
    if path.suffix not in (".yaml", ".yml"):
        raise RecipeError(
            f"no {what} {name_or_file!r}{nearest(name_or_file, list(known))}; there are {', '.join(known)}, "
            "or give a YAML file"
        )
    return path


def named_training(name: str) -> dict[str, Any]:
    """The training section of that name.

    Raises
    ------
    RecipeError
        There is none; the nearest and all others are named.
    """
    known = known_trainings()
    if name not in known:
        raise RecipeError(f"no training recipe {name!r}{nearest(name, list(known))}; there are {', '.join(known)}")
    return dict(read_values(known[name])["training"])
