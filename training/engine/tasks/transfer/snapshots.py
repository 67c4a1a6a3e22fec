"""Pictures while training: a few fixed transfers, drawn small, so that a person sees the network learn."""

import functools
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import nn

from datagen.common.arrays import Floats, Integers
from datagen.mesh.geometry import Mesh, standing_point
from training.data.batch import Batch
from training.inference.predict import predict
from training.objectives import PMD_UNIT
from training.objectives.metrics import point_mesh_distance
from training.viz.render.camera import Camera, frame
from training.viz.render.renderer import render_mesh
from training.viz.style import DPI, INK, PAGE, QUIET, ROLE_COLORS, saved

COLUMNS = {"source": "Source", "target": "Target", "output": "Output", "truth": "Ground truth"}
_PANEL, _MARGIN, _HEAD, _GAP = (230, 260), 16, 84, 10
_FAR = 2.5  # in the normalised box; networks end in 2 tanh, so only a broken one reaches farther


def draw_snapshot(
    network: nn.Module,
    batch: Batch,
    faces: Integers,
    path: str | os.PathLike[str],
    title: str,
    *,
    examples: int = 3,
) -> Path:
    """Draw the first transfers of a batch: source, target, output and truth in columns, examples in rows.

    What does not change from picture to picture (all but the outputs) is drawn once in a process. A network that is
    broken is drawn as it is: an output that is not finite is said to be so.

    Parameters
    ----------
    network
        Called as ``network(source=, target=)``, in the mode that it is in.
    batch
        Normalised vertices [batch, vertex, 3], Y up, on any device.
    faces : array [f, 3]
        Triangles of all its meshes.
    path
        The PNG to write.
    title
        For example ``"step 1,000, PMD unseen 12.3e-4"``.
    examples
        How many rows.
    """
    rows = _rows(network, batch.part(0, examples), faces)
    canvas = np.concatenate([np.concatenate([np.asarray(p) for p in row.panels()], 1) for row in rows], 0)
    height, width = canvas.shape[0] + _HEAD + _MARGIN, canvas.shape[1] + 2 * _MARGIN
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor=PAGE)
    axes = figure.add_axes((_MARGIN / width, _MARGIN / height, canvas.shape[1] / width, canvas.shape[0] / height))
    axes.imshow(canvas, interpolation="none", aspect="auto")
    axes.axis("off")
    figure.text(_MARGIN / width, 1 - 24 / height, title, fontsize=8, color=INK, va="center", parse_math=False)
    for column, (role, words) in enumerate(COLUMNS.items()):
        middle = (_MARGIN + (column + 0.5) * _PANEL[0]) / width
        color = tuple(0.75 * part for part in ROLE_COLORS[role])
        figure.text(middle, 1 - 62 / height, words, fontsize=7, color=color, ha="center", va="center", weight="bold")
    for number, row in enumerate(rows):
        place = (2.5 * _PANEL[0], number * _PANEL[1] + _GAP)
        axes.text(*place, row.caption, fontsize=6, color=QUIET, ha="center", va="center")
    return saved(figure, path)


@dataclass(frozen=True)
class _Row:
    """One transfer: vertices [v, 3] of its meshes, standing on the ground at the origin."""

    meshes: dict[str, Floats]
    faces: Integers
    caption: str

    def panels(self) -> list[NDArray[np.uint8]]:
        """The pictures of its meshes, all by the camera that holds the given ones."""
        given = {role: vertices for role, vertices in self.meshes.items() if role != "output"}
        camera = frame([Mesh(vertices, self.faces) for vertices in given.values()], size=_PANEL, margin=0.06)
        return [
            _given_panel(role, given[role].tobytes(), self.faces.tobytes(), camera)
            if role in given
            else _panel(role, self.meshes[role], self.faces, camera)
            for role in COLUMNS
        ]


def _rows(network: nn.Module, batch: Batch, faces: Integers) -> list[_Row]:
    output = predict(network, batch)
    pmd = point_mesh_distance(output, batch.truth).tolist()
    parts = {"source": batch.source, "target": batch.target, "output": output, "truth": batch.truth}
    arrays = {role: part.detach().cpu().double().numpy() for role, part in parts.items()}
    return [
        _Row(
            meshes={
                role: arrays[role][number] - standing_point(arrays["truth" if role == "output" else role][number])
                for role in COLUMNS
            },
            faces=np.asarray(faces, np.int64),
            caption=f"PMD {pmd[number] / PMD_UNIT:.1f}e-4" if np.isfinite(pmd[number]) else "not finite",
        )
        for number in range(len(pmd))
    ]


@functools.lru_cache(maxsize=32)
def _given_panel(role: str, vertices: bytes, faces: bytes, camera: Camera) -> NDArray[np.uint8]:
    return _panel(role, np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3), camera)


def _panel(role: str, vertices: Floats, faces: Integers, camera: Camera) -> NDArray[np.uint8]:
    if not np.isfinite(vertices).all():
        return np.full((_PANEL[1], _PANEL[0], 3), 255, np.uint8)
    inside = np.clip(vertices, -_FAR, _FAR)
    return render_mesh(inside, faces, colors=ROLE_COLORS[role], camera=camera, size=_PANEL, background=PAGE)
