"""Pictures while training: a few fixed transfers, drawn small, so that a person sees the network learn."""

import os
from pathlib import Path

import numpy as np
from torch import nn

from datagen.common.arrays import Integers
from datagen.mesh.geometry import Mesh
from training.data.batch import Batch
from training.inference.predict import predict
from training.objectives import PMD_UNIT
from training.objectives.metrics import point_mesh_distance
from training.viz.mesh_grid import Panel, Row, mesh_grid, standing
from training.viz.style import ROLE_COLORS

COLUMNS = {"source": "Source", "target": "Target", "output": "Output", "truth": "Ground truth"}
_FAR = 1.5  # in the normalised box, whose half is 1: what a broken network gives is drawn no farther off


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

    A network that is broken is drawn as it is: an output that is not finite is said to be so.

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
    some = batch.part(0, examples)
    output = predict(network, some)
    errors = point_mesh_distance(output, some.truth).tolist()
    parts = {"source": some.source, "target": some.target, "output": output, "truth": some.truth}
    meshes = {role: part.detach().cpu().double().numpy() for role, part in parts.items()}

    def panel(role: str, number: int) -> Panel | str:
        vertices = meshes[role][number]
        if not np.isfinite(vertices).all():
            return "not finite"
        placed = standing(vertices.clip(-_FAR, _FAR), meshes["truth"][number] if role == "output" else None)
        return Panel(Mesh(placed, np.asarray(faces, np.int64)), ROLE_COLORS[role])

    rows = [
        Row(f"PMD\n{error / PMD_UNIT:,.1f}e-4" if np.isfinite(error) else "", [panel(role, number) for role in COLUMNS])
        for number, error in enumerate(errors)
    ]
    return mesh_grid(rows, path, columns=list(COLUMNS.values()), title=title, one_scale=False)
