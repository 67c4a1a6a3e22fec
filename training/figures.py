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

from training.rendering import Camera, Floats, Integers, MeshLike, frame, render_mesh

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
_DPI = 200
_INK, _QUIET, _RULE = "#1d2430", "#6b7483", "#e3e6ea"
_PAGE = (1.0, 1.0, 1.0)


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
        page.text(middle, 82, meaning, size=7, color=_QUIET, anchor="center")
    for index, example in enumerate(rows):
        top = 110 + index * (panel[1] + 46)
        page.rule(top)
        page.text(24, top + 27, example.title, size=7.5)
        page.text(page.width - 24, top + 27, example.metrics, size=7.5, color=_QUIET, anchor="right")
        for column, picture in enumerate(_row_pictures(example, scale, limit, panel)):
            page.picture(picture, 20 + column * panel[0], top + 46)
    page.rule(page.height - 112)
    left = 20 + 4 * panel[0]
    bar = page.figure.add_axes(page.box(left + 18, page.height - 92, panel[0] - 36, 18))
    _colorbar(page.figure, bar, limit, f"per-vertex error ({scale.unit})")
    return _saved(page.figure, path)


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
            picture = render_mesh(vertices, faces, colors=hue, camera=camera, size=panel, background=_PAGE)
            page.picture(picture, 70 + column * panel[0], top)
    return _saved(page.figure, path)


@dataclass(frozen=True)
class _Placed:
    vertices: Floats
    faces: Integers


class _Page:
    """A figure laid out in pixels from its top left corner."""

    def __init__(self, *, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor=_PAGE)

    def box(self, left: float, top: float, width: float, height: float) -> tuple[float, float, float, float]:
        """Return a rectangle as matplotlib counts it."""
        return left / self.width, 1 - (top + height) / self.height, width / self.width, height / self.height

    def text(self, x: float, y: float, words: str, *, size: float, anchor: str = "left", **style: Any) -> None:
        """Write words, vertically centred at y; `parse_math` off, for names may hold dollar signs."""
        where = x / self.width, 1 - y / self.height
        style = {"color": _INK, "parse_math": False, **style}
        self.figure.text(*where, words, fontsize=size, ha=anchor, va="center", **style)

    def rule(self, y: float) -> None:
        """Draw a hairline across the page."""
        self.figure.add_axes(self.box(20, y, self.width - 40, 1), facecolor=_RULE, xticks=[], yticks=[], frame_on=True)
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
        mesh.vertices, mesh.faces, colors=colors, camera=camera, size=size, background=_PAGE, shading=shading
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
    bar.ax.tick_params(labelsize=6.5, colors=_INK, length=2, width=0.5, pad=2)
    bar.ax.locator_params(nbins=4)
    bar.set_label(label, fontsize=7, color=_INK, labelpad=2)


def _saved(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write under a temporary name and rename, so that a reader never meets half a picture."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        figure.savefig(temporary, format="png", dpi=_DPI)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def training_curve(
    journal_rows: Sequence[Mapping[str, float]],
    path: str | os.PathLike[str],
    *,
    baselines: Mapping[str, float] | None = None,
) -> Path:
    """Draw losses and evaluation PMD over steps on log scales, and the learning rate as a strip below.

    Parameters
    ----------
    journal_rows : sequence of dict
        ``step`` and any of ``loss/*``, ``evaluation/pmd*``, ``learning_rate``; missing, non-finite and non-positive
        values are left out.
    path : path of the PNG to write
    baselines : dict, optional
        Name -> PMD of doing nothing, drawn as dashed lines.
    """
    losses = _keys(journal_rows, "loss/")
    evaluations = _keys(journal_rows, "evaluation/pmd")
    rates = _keys(journal_rows, "learning_rate")
    panels = [("loss", losses, 3.0), ("PMD", evaluations, 2.4), ("learning\nrate", rates, 0.55)]
    panels = [panel for panel in panels if panel[1]]
    if not panels:
        raise ValueError("the journal holds no finite loss, evaluation or learning rate to draw")
    heights = [panel[2] for panel in panels]
    figure = Figure(figsize=(8, sum(heights) * 0.95 + 0.5), dpi=_DPI, facecolor=_PAGE, layout="constrained")
    all_axes = figure.subplots(len(panels), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    for axes, (label, keys, _) in zip(all_axes, panels, strict=True):
        _styled(axes, label)
        if label.startswith("learning"):
            axes.fill_between(*_series(journal_rows, keys[0]), color="#cfd6df", linewidth=0)
            axes.set_ylim(bottom=0)
            axes.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
            continue
        _draw_terms(axes, journal_rows, keys, dots=label == "PMD")
        _draw_baselines(axes, (baselines or {}) if label == "PMD" else {})
        axes.set_yscale("log")
        place = {"loc": "lower right", "bbox_to_anchor": (1, 1), "borderaxespad": 0.1}
        axes.legend(fontsize=7, frameon=False, ncols=6, labelcolor=_INK, **place)
    all_axes[-1].set_xlabel("step", fontsize=8, color=_INK)
    return _saved(figure, path)


_TERM_COLORS = ("#1d2430", "#3f74c8", "#e08b3c", "#2f9e83", "#a868b8", "#c25b5b", "#8a8f3a", "#5aa9c9")


def _keys(rows: Sequence[Mapping[str, float]], prefix: str) -> list[str]:
    """Return the keys with a drawable value, totals first."""
    names = {key for row in rows for key in row if key.startswith(prefix)}
    drawable = [name for name in names if len(_series(rows, name)[0])]
    return sorted(drawable, key=lambda name: (not name.endswith("total"), name))


def _series(rows: Sequence[Mapping[str, float]], key: str) -> tuple[Floats, Floats]:
    """Return steps and values of one key, in order of step, without what a log scale cannot show."""
    pairs = np.array([(row["step"], row[key]) for row in rows if row.get(key) is not None and "step" in row], float)
    pairs = pairs.reshape(-1, 2)
    pairs = pairs[np.isfinite(pairs).all(1) & (pairs[:, 1] > 0)]
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    return pairs[:, 0], pairs[:, 1]


def _smooth(values: Floats) -> Floats:
    """Return a running geometric mean over about a fiftieth of the series, centred."""
    reach = max(len(values) // 50, 1)
    sums = np.cumsum(np.concatenate([[0.0], np.log(values)]))
    index = np.arange(len(values))
    low, high = np.maximum(index - reach, 0), np.minimum(index + reach + 1, len(values))
    return np.asarray(np.exp((sums[high] - sums[low]) / (high - low)))


def _styled(axes: Axes, label: str) -> None:
    axes.set_ylabel(label, fontsize=8, color=_INK)
    axes.tick_params(labelsize=7, colors=_QUIET, which="both", width=0.5)
    axes.yaxis.get_offset_text().set_fontsize(6.5)
    axes.grid(True, which="major", color=_RULE, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.margins(x=0.01)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#b9c0c9")


def _draw_terms(axes: Axes, rows: Sequence[Mapping[str, float]], keys: Sequence[str], *, dots: bool) -> None:
    colors = _TERM_COLORS[1:] if dots else _TERM_COLORS
    for index, key in enumerate(keys):
        steps, values = _series(rows, key)
        style: dict[str, Any] = {
            "color": colors[index % len(colors)],
            "label": key.split("/", 1)[-1].removeprefix("pmd_").replace("_", " "),
        }
        if dots:
            axes.plot(steps, values, linewidth=1.6, marker="o", markersize=3, **style)
        else:
            axes.plot(steps, values, linewidth=0.5, alpha=0.28, color=style["color"])
            axes.plot(steps, _smooth(values), linewidth=1.8, **style)


def _draw_baselines(axes: Axes, baselines: Mapping[str, float]) -> None:
    for name, value in baselines.items():
        if np.isfinite(value) and value > 0:
            axes.axhline(value, color=_QUIET, linewidth=0.9, linestyle=(0, (5, 3)))
            axes.annotate(
                name, (1, value), xycoords=("axes fraction", "data"), xytext=(-2, 3), textcoords="offset points",
                ha="right", fontsize=7, color=_QUIET, parse_math=False,
            )  # fmt: skip
