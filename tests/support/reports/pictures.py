"""Meshes to draw, pictures read back, and figures caught before they are written."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from datagen.mesh.geometry import Mesh


def octahedron(scale: float = 1.0, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    points = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = [(x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]
    return Mesh(scale * points + shift, np.array(faces))


def pixels(path: Path) -> np.ndarray[Any, Any]:
    """The picture [height, width, 3] as integers."""
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def caught(monkeypatch: pytest.MonkeyPatch, *modules: ModuleType) -> list[Figure]:
    """The figures that modules draw from now on, instead of files."""
    made: list[Figure] = []
    for module in modules:
        monkeypatch.setattr(module, "saved", lambda figure, path: (made.append(figure), Path(path))[1])
    return made
