"""The pictures of a comparison by column: meshes, errors below them, close-ups below those."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh
from training.viz.close_up import CloseUp, close_up_size, outlined
from training.viz.render.camera import Camera
from training.viz.render.renderer import render_mesh
from training.viz.style import PAGE, ROLE_COLORS, error_colors
from training.viz.transfer_example import Comparison, camera_of, in_view, look_at, output_of

SIDE = 20  # pixels of margin
_AIR = 8  # pixels left free above and below what a strip shows
_CLOSE_UP_MARGIN = 14
_WIDTH = 312  # of a panel by default: five of them make a figure of 1600 pixels
Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Columns:
    """Which columns there are, and their panels. Errors of several methods have a strip of their own below."""

    methods: Sequence[str]
    panel: tuple[int, int]
    errors: bool

    @property
    def stacked(self) -> bool:
        return self.errors and len(self.methods) > 1

    @property
    def names(self) -> list[str]:
        """The meshes of the first strip, from left to right; ``error`` is the error of the only method."""
        end = ["truth"] if self.errors else []
        beside = ["error"] if self.errors and not self.stacked else []
        return ["source", "target", *map(output_of, self.methods), *end, *beside]

    def left(self, column: int) -> int:
        return SIDE + column * self.panel[0]

    def middle(self, column: int) -> float:
        return self.left(column) + self.panel[0] / 2


@dataclass(frozen=True)
class Strip:
    """Pictures by column, all cut to the rows of pixels in which any of them shows something."""

    pictures: Mapping[int, Picture]
    height: int

    @classmethod
    def of(cls, pictures: Mapping[int, Picture | None]) -> "Strip":
        drawn = {column: picture for column, picture in pictures.items() if picture is not None}
        if not drawn:
            return cls({}, 0)
        shown = np.flatnonzero(np.any([(picture < 250).any((1, 2)) for picture in drawn.values()], axis=0))
        first, last = (int(shown[0]), int(shown[-1])) if len(shown) else (0, 0)
        rows = slice(max(first - _AIR, 0), last + 1 + _AIR)
        cut = {column: picture[rows] for column, picture in drawn.items()}
        return cls(cut, len(next(iter(cut.values()))))


@dataclass(frozen=True)
class ShownRow:
    """A comparison, its placed meshes, and each method's errors [v] in the unit of the colour bar."""

    comparison: Comparison
    meshes: Mapping[str, Mesh]
    errors: Mapping[str, Floats]

    @property
    def largest_mean(self) -> float:
        return max((float(errors.mean()) for errors in self.errors.values()), default=0.0)

    def strips(self, columns: Columns, limit: float) -> list[Strip]:
        """The meshes and, where they have a strip of their own, the errors."""
        camera = camera_of(self.meshes, columns.panel)
        meshes = {place: self.picture(name, camera, columns.panel) for place, name in enumerate(columns.names)}
        heats = {
            place: self.heat(method, camera, columns.panel, limit) for place, method in enumerate(columns.methods, 2)
        }
        if columns.stacked and len(self.errors) > 1:
            near = CloseUp.of(self.meshes["truth"], [self.meshes[output_of(method)] for method in self.errors])
            marked = {place: _marked(name, meshes[place], near, camera) for place, name in enumerate(columns.names)}
            return [Strip.of(marked), Strip.of(heats), self._close_ups(columns, near.camera(camera))]
        if columns.stacked:
            return [Strip.of(meshes), Strip.of(heats)]
        return [Strip.of({**meshes, len(columns.names) - 1: heats[2]} if columns.errors else meshes)]

    def _close_ups(self, columns: Columns, camera: Camera) -> Strip:
        """Each output, and the truth, seen near by; framed, each in the middle of its column."""
        size = close_up_size(columns.panel[0] - 2 * _CLOSE_UP_MARGIN)
        found = {}
        for place, name in enumerate(columns.names):
            picture = None if name in ("source", "target") else self.picture(name, camera, size)
            if picture is not None:
                picture = outlined(picture, np.zeros(2, int), np.array(picture.shape[:2]) - 1)
                found[place] = np.pad(picture, (2 * (_AIR,), 2 * (_CLOSE_UP_MARGIN,), (0, 0)), constant_values=255)
        return Strip.of(found)

    def picture(self, column: str, camera: Camera, size: tuple[int, int]) -> Picture | None:
        """The mesh of a column as its file has it, else in the colour of its role; None where there is none."""
        if column not in self.meshes:
            return None
        mesh, color = self.meshes[column], ROLE_COLORS[column.partition(" ")[0]]
        how: dict[str, Any] = {"camera": camera, "size": size, "background": PAGE}
        return render_mesh(
            mesh.vertices, mesh.faces, colors=color, look=look_at(self.comparison.meshes()[column]), **how
        )

    def heat(self, method: str, camera: Camera, size: tuple[int, int], limit: float) -> Picture | None:
        """A method's output in the colours of its errors; None where there are none."""
        if method not in self.errors:
            return None
        mesh, colors = self.meshes[output_of(method)], error_colors(self.errors[method], limit)
        return render_mesh(
            mesh.vertices, mesh.faces, colors=colors, camera=camera, size=size, background=PAGE, shading=0.55
        )


def _marked(name: str, picture: Picture | None, near: CloseUp, camera: Camera) -> Picture | None:
    return picture if picture is None or name in ("source", "target") else near.marked(picture, camera)


def panel_size(rows: Sequence[ShownRow]) -> tuple[int, int]:
    """Panels as high as most rows need: tall for people, low for dogs."""
    extents = [high - low for _, low, high in (in_view(row.meshes) for row in rows)]
    shape = np.median([extent[1] / max(extent[0], 1e-12) for extent in extents])
    return _WIDTH, round(_WIDTH * float(np.clip(shape, 0.7, 1.3)))
