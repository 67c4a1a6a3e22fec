"""The weights that come with the project, by name."""

from pathlib import Path

KINDS = {"human": "a person", "dressed": "a person", "animals": "an animal on four legs"}
"""Those that a transfer chooses from where none are named, and what they pose; the first of equally good ones."""


def own_weights(name: str) -> Path:
    """The folder of weights that come with the project."""
    return Path(__file__).parent / name


def own_names() -> list[str]:
    """The names of the weights that come with the project."""
    return sorted(manifest.parent.name for manifest in Path(__file__).parent.glob("*/manifest.json"))


def weights_named(name: str) -> Path:
    """The path of weights that a person names: a path that is there, or the name of some that come with the project."""
    place, own = Path(name), own_weights(name)
    return own if place.name == name and not place.exists() and own.is_dir() else place


def name_of(weights: Path) -> str:
    """What a person calls weights: the name of those that come with the project, else their path."""
    return weights.name if weights == own_weights(weights.name) else str(weights)
