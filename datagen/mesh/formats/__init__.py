"""One file a mesh format, and the surface that they share."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from datagen.mesh.formats.surface import Format

FORMATS = {".obj": "obj", ".ply": "ply", ".off": "off_stl", ".glb": "glb", ".stl": "off_stl"}
"""Suffix of each format, and the module here whose ``FORMATS`` has it; a module is imported when it is needed."""


def format_of(suffix: str) -> "Format":
    """Return how files of a suffix of FORMATS are read and built."""
    found: Format = import_module(f"{__name__}.{FORMATS[suffix]}").FORMATS[suffix]
    return found
