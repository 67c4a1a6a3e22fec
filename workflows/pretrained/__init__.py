"""The weights that come with the project, by name."""

from pathlib import Path

PEOPLE = "human"
"""Those that pose people, which a transfer takes where none are named."""


def weights_named(name: str) -> Path:
    """The path of weights that a person names: a path that is there, or the name of some that come with the project."""
    place, own = Path(name), Path(__file__).parent / name
    return own if place.name == name and not place.exists() and own.is_dir() else place
