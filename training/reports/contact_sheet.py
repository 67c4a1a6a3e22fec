"""A picture of a dataset: identities down, poses across."""

from pathlib import Path

import numpy as np

from datagen.common.arrays import Floats
from datagen.mesh.geometry import bounding_box
from datagen.store import Dataset
from training.viz.mesh_grid import contact_sheet


def draw_contact_sheet(dataset: Dataset, path: Path, *, identities: int = 6, poses: int = 8) -> Path:
    """Draw some identities (rows) in some poses (columns), both spread over the whole grid.

    Where training identities have no unseen poses, the seen ones are shown.
    """
    grid = dataset.grid
    rows = _spread(grid.identity_count, identities)
    common = sorted(set.intersection(*(set(grid.poses_of(identity).tolist()) for identity in rows)))
    columns = [common[place] for place in _spread(len(common), poses)]
    meshes = [[_standing(vertices) for vertices in dataset.vertices(i, columns)] for i in rows]
    labels = [f"identity {i}\n{grid.split(i)}" for i in rows]
    faces = [dataset.faces(i) for i in rows]
    return contact_sheet(meshes, faces, labels, [f"pose {p} ({grid.pose_type(p)})" for p in columns], path)


def _spread(count: int, wanted: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, wanted).astype(int)).tolist()


def _standing(vertices: Floats) -> Floats:
    return vertices - bounding_box(vertices).centre
