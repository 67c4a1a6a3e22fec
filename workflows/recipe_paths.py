"""Paths in recipes: those of files beside a recipe become absolute, as tasks run in other folders."""

import os
from pathlib import Path
from typing import Any

from datagen.errors import RecipeError
from datagen.recipe import ANIMALS
from datagen.recipe import PATH_KEYS as DATA_PATH_KEYS
from training.recipe import PATH_KEYS as TRAINING_PATH_KEYS


def with_absolute_paths(values: Any, folder: Path) -> Any:
    """The same with absolute paths of files that lie in ``folder``: tasks run in other folders.

    Raises
    ------
    RecipeError
        On a cluster, where this folder is a copy that is thrown away, a path is relative.
    """
    if isinstance(values, dict):
        return {
            key: _absolute(value, folder, key in TRAINING_PATH_KEYS)
            if key in DATA_PATH_KEYS | TRAINING_PATH_KEYS
            else with_absolute_paths(value, folder)
            for key, value in values.items()
        }
    return [with_absolute_paths(value, folder) for value in values] if isinstance(values, list) else values


def _absolute(value: Any, folder: Path, always: bool) -> Any:
    """Data's paths that do not lie in the folder may be found elsewhere; training's may be folders still to be made."""
    if not isinstance(value, str) or value in ("", ANIMALS) or "://" in value:
        return value
    path = Path(value).expanduser()
    if not (always or (folder / path).exists()):
        return value
    if "RAY_ADDRESS" in os.environ and not path.is_absolute():
        raise RecipeError(
            f"{value!r} is a relative path, which other machines do not have. On a cluster name a full one"
        )
    return str((folder / path).resolve())
