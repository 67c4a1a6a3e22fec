"""Figures for papers and run folders: transfer examples, training curves, contact sheets; written atomically as PNG."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from training.figure_style import DPI, INK, PAGE, QUIET, RULE, saved
from training.rasteriser import Floats, Integers
from training.rendering import Camera, MeshLike, frame, render_mesh

ROLE_COLORS: Mapping[str, tuple[float, float, float]] = {
    "source": (0.36, 0.55, 0.82),
    "target": (0.91, 0.60, 0.32),
    "output": (0.30, 0.66, 0.56),
    "truth": (0.68, 0.70, 0.74),
}
COLUMNS = (
    ("Source", "gives the pose"),
    ("Target", "gives the identity"),
    ("Output", "transferred"),
    ("Ground truth", "target in source pose"),
    ("Error", "distance to truth"),
)
ERROR_COLORS = colormaps["magma_r"](np.linspace(0.03, 0.86, 256))[:, :3]
ERROR_MAP = ListedColormap(ERROR_COLORS, name="error")
_SHEET_HUES = ("#5B8CD1", "#E8995A", "#55A98F", "#B98BC6", "#D0AE48", "#CE7474")


@dataclass(frozen=True)
class TransferExample:
    """One transfer; all meshes Y up, facing +Z, in one unit.

    Parameters
    ----------
    title : str
        Caption, for example ``"unseen pose 231 -> identity anny-0019"``.
    source, target : mesh
        Who gives the pose, and who gives the identity.
    output, truth : mesh
        The network's mesh and the right one, with the vertices of the target in the same order.
    metrics : str
        Numbers to print beside the title, for example ``"PMD 12.3e-4"``.
    """

    title: str
    source: MeshLike
    target: MeshLike
    output: MeshLike
    truth: MeshLike
    metrics: str = ""


@dataclass(frozen=True)
class ErrorScale:
    """How errors are told: `factor` turns the vertices' unit into `unit`; `limit` (in `unit`) ends the colours."""

    unit: str = "cm"
    factor: float = 100.0
    limit: float | None = None

    def resolved(self, examples: Sequence[TransferExample]) -> float:
        """Return the limit, by default the 99th percentile of the errors of all examples, in `unit`."""
        if self.limit is not None:
            return self.limit
        errors = np.concatenate([vertex_errors(example) for example in examples])
        return max(float(np.percentile(errors, 99)) * self.factor, 1e-12)


def vertex_errors(example: TransferExample) -> Floats:
    """Return the Euclidean distance [v] of every output vertex to the same vertex of the truth, in their unit."""
    output, truth = np.asarray(example.output.vertices, float), np.asarray(example.truth.vertices, float)
    if output.shape != truth.shape:
        raise ValueError(f"{example.title}: output {output.shape} and truth {truth.shape} differ in shape")
    return np.asarray(np.linalg.norm(output - truth, axis=1))


def error_colors(errors: Floats, limit: float) -> Floats:
    """Return sRGB [v, 3] in 0..1 for errors [v], pale at 0 and dark at `limit` and above."""
    level = np.clip(np.asarray(errors, float) / limit, 0, 1)
    return np.asarray(ERROR_COLORS[np.rint(255 * level).astype(int)])


def placed(example: TransferExample) -> dict[str, Floats]:
    """Return the vertices of each role set down on the ground at the origin; output and truth are moved together."""
    roles = {role: np.asarray(getattr(example, role).vertices, float) for role in ROLE_COLORS}
    for role, vertices in roles.items():
        if bad := int((~np.isfinite(vertices).all(1)).sum()):
            raise ValueError(f"{example.title}: {bad} of {len(vertices)} vertices of the {role} are not finite")
    anchors = {**roles, "output": roles["truth"]}
    return {role: vertices - _standing_point(anchors[role]) for role, vertices in roles.items()}


def transfer_figure(
    rows: Sequence[TransferExample],
    path: str | os.PathLike[str],
    *,
    error_scale: ErrorScale | None = None,
    panel: tuple[int, int] = (312, 360),
) -> Path:
    """Draw source, target, output, ground truth and error of each example as one row.

    The panels of a row share camera and scale; the error colours are shared by all rows.

    Parameters
    ----------
    rows : sequence of TransferExample
    path : path of the PNG to write
    error_scale : ErrorScale, optional
        Unit of the colour bar; by default centimetres for vertices in metres.
    panel : (int, int)
        Width and height of a panel in pixels; by default the figure is 1600 px wide.
    """
    if not rows:
        raise ValueError("transfer_figure needs at least one example")
    scale = error_scale or ErrorScale()
    limit = scale.resolved(rows)
    page = _Page(width=5 * panel[0] + 40, height=110 + len(rows) * (panel[1] + 46) + 120)
    for column, (header, meaning) in enumerate(COLUMNS):
        middle = 20 + (column + 0.5) * panel[0]
        page.text(middle, 44, header, size=10, weight="bold", anchor="center")
        page.text(middle, 82, meaning, size=7, color=QUIET, anchor="center")
    for index, example in enumerate(rows):
        top = 110 + index * (panel[1] + 46)
        page.rule(top)
        page.text(24, top + 27, example.title, size=7.5)
        page.text(page.width - 24, top + 27, example.metrics, size=7.5, color=QUIET, anchor="right")
        for column, picture in enumerate(_row_pictures(example, scale, limit, panel)):
            page.picture(picture, 20 + column * panel[0], top + 46)
    page.rule(page.height - 112)
    left = 20 + 4 * panel[0]
    bar = page.figure.add_axes(page.box(left + 18, page.height - 92, panel[0] - 36, 18))
    _colorbar(page.figure, bar, limit, f"per-vertex error ({scale.unit})")
    return saved(page.figure, path)


def contact_sheet(
    grid: Sequence[Sequence[Floats]],
    faces_per_row: Sequence[Integers],
    row_labels: Sequence[str],
    column_labels: Sequence[str],
    path: str | os.PathLike[str],
    *,
    panel: tuple[int, int] = (210, 250),
) -> Path:
    """Draw a grid of meshes, identities down and poses across, all on one scale.

    Parameters
    ----------
    grid : rows of arrays [v, 3]
        Vertices, Y up, facing +Z; rows may differ in vertex count.
    faces_per_row : arrays [f, 3]
        The triangles of each row.
    row_labels, column_labels : sequence of str
    path : path of the PNG to write
    panel : (int, int)
        Width and height of a panel in pixels.
    """
    if not len(grid) == len(faces_per_row) == len(row_labels) or any(len(row) != len(column_labels) for row in grid):
        raise ValueError("grid, faces_per_row, row_labels and column_labels differ in length")
    standing = [[np.asarray(one, float) - _standing_point(np.asarray(one, float)) for one in row] for row in grid]
    camera = frame(
        [_Placed(one, faces) for row, faces in zip(standing, faces_per_row, strict=True) for one in row], size=panel
    )
    page = _Page(width=90 + len(column_labels) * panel[0], height=70 + len(grid) * panel[1] + 20)
    for column, label in enumerate(column_labels):
        page.text(70 + (column + 0.5) * panel[0], 40, label, size=7.5, anchor="center", weight="bold")
    for index, (row, faces) in enumerate(zip(standing, faces_per_row, strict=True)):
        top = 70 + index * panel[1]
        page.text(38, top + panel[1] / 2, row_labels[index], size=7.5, anchor="center", rotation=90, weight="bold")
        hue = _hex(_SHEET_HUES[index % len(_SHEET_HUES)])
        for column, vertices in enumerate(row):
            picture = render_mesh(vertices, faces, colors=hue, camera=camera, size=panel, background=PAGE)
            page.picture(picture, 70 + column * panel[0], top)
    return saved(page.figure, path)


@dataclass(frozen=True)
class _Placed:
    vertices: Floats
    faces: Integers


class _Page:
    """A figure laid out in pixels from its top left corner."""

    def __init__(self, *, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor=PAGE)

    def box(self, left: float, top: float, width: float, height: float) -> tuple[float, float, float, float]:
        """Return a rectangle as matplotlib counts it."""
        return left / self.width, 1 - (top + height) / self.height, width / self.width, height / self.height

    def text(self, x: float, y: float, words: str, *, size: float, anchor: str = "left", **style: Any) -> None:
        """Write words, vertically centred at y; `parse_math` off, for names may hold dollar signs."""
        where = x / self.width, 1 - y / self.height
        style = {"color": INK, "parse_math": False, **style}
        self.figure.text(*where, words, fontsize=size, ha=anchor, va="center", **style)

    def rule(self, y: float) -> None:
        """Draw a hairline across the page."""
        self.figure.add_axes(self.box(20, y, self.width - 40, 1), facecolor=RULE, xticks=[], yticks=[], frame_on=True)
        for spine in self.figure.axes[-1].spines.values():
            spine.set_visible(False)

    def picture(self, pixels: npt.NDArray[np.uint8], left: float, top: float) -> None:
        """Place a picture pixel for pixel."""
        axes = self.figure.add_axes(self.box(left, top, pixels.shape[1], pixels.shape[0]))
        axes.imshow(pixels, interpolation="none", aspect="auto")
        axes.axis("off")


def _row_pictures(
    example: TransferExample, scale: ErrorScale, limit: float, size: tuple[int, int]
) -> list[npt.NDArray[np.uint8]]:
    meshes = {role: _Placed(vertices, getattr(example, role).faces) for role, vertices in placed(example).items()}
    camera = frame(list(meshes.values()), size=size, margin=0.06)
    pictures = [_picture(mesh, ROLE_COLORS[role], camera, size) for role, mesh in meshes.items()]
    heat = error_colors(scale.factor * vertex_errors(example), limit)
    return [*pictures, _picture(meshes["output"], heat, camera, size, shading=0.55)]


def _picture(
    mesh: MeshLike, colors: npt.ArrayLike, camera: Camera, size: tuple[int, int], shading: float = 1.0
) -> npt.NDArray[np.uint8]:
    return render_mesh(
        mesh.vertices, mesh.faces, colors=colors, camera=camera, size=size, background=PAGE, shading=shading
    )


def _standing_point(vertices: Floats) -> Floats:
    low, high = vertices.min(0), vertices.max(0)
    return np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])


def _hex(color: str) -> tuple[float, ...]:
    return tuple(int(color[start : start + 2], 16) / 255 for start in (1, 3, 5))


def _colorbar(figure: Figure, axes: Axes, limit: float, label: str) -> None:
    bar = figure.colorbar(
        ScalarMappable(Normalize(0, limit), ERROR_MAP), cax=axes, orientation="horizontal", extend="max"
    )
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=6.5, colors=INK, length=2, width=0.5, pad=2)
    bar.ax.locator_params(nbins=4)
    bar.set_label(label, fontsize=7, color=INK, labelpad=2)
