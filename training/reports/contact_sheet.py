"""A picture of a dataset: identities down, poses across."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb

from datagen.grid import POSE_TYPES, SPLITS, Grid
from datagen.mesh.geometry import Mesh
from datagen.mesh.parts import part_colors
from datagen.store import Dataset
from training.viz.mesh_grid import Panel, Row, mesh_grid, standing

_HUES = ("#5B8CD1", "#E8995A", "#55A98F", "#B98BC6", "#D0AE48", "#CE7474")
_ROWS, _COLUMNS = len(_HUES), 8


def draw_contact_sheet(dataset: Dataset, path: Path) -> Path:
    """Draw some identities (rows) in some poses (columns), spread over both splits, both kinds of poses, and all steps.

    The first step is the recipe's own grid, the others are what was appended. Meshes that the dataset does not hold,
    training identities in unseen poses, are named as such. Dressed people are coloured by part.
    """
    grid = dataset.grid
    rows, columns = chosen(identity_groups(grid), _ROWS), chosen(pose_groups(grid), _COLUMNS)
    before = grid.steps[0].training + grid.steps[0].evaluation, grid.steps[0].seen + grid.steps[0].unseen
    headings = [f"pose {p}\n{grid.pose_type(p)}{_appended(p, before[1])}" for p in columns]
    labels = [f"identity {i}\n{grid.split(i)}{_appended(i, before[0])}" for i in rows]
    title = f"{len(rows)} of {grid.identity_count:,} identities in {len(columns)} of {grid.pose_count:,} poses"
    hues = _HUES[: len(rows)]
    page = [Row(label, _panels(dataset, i, columns, hue)) for label, i, hue in zip(labels, rows, hues, strict=True)]
    return mesh_grid(page, path, columns=headings, title=title)


def identity_groups(grid: Grid) -> list[range]:
    """Identity numbers of each split that each step adds."""
    return [range(*span) for split in SPLITS for span in grid.identity_spans(split)]


def pose_groups(grid: Grid) -> list[range]:
    """Pose numbers of each kind that each step adds."""
    found, first = list[range](), 0
    for step in grid.steps:
        for kind in POSE_TYPES:
            found.append(range(first, first := first + getattr(step, kind)))
    return found


def chosen(groups: Iterable[Sequence[int]], wanted: int) -> list[int]:
    """Return so many numbers in order, spread over each group, of which larger ones give more and none gives nothing.

    Where there are more groups than numbers, some groups give one.
    """
    some = [group for group in groups if len(group)]
    if len(some) > wanted:
        some = [some[place] for place in _spread(len(some), wanted)]
    shares = [1] * len(some)
    while sum(shares) < wanted and any(share < len(group) for share, group in zip(shares, some, strict=True)):
        lacking = [len(group) / share if share < len(group) else 0 for share, group in zip(shares, some, strict=True)]
        shares[int(np.argmax(lacking))] += 1
    return sorted(
        group[place] for share, group in zip(shares, some, strict=True) for place in _spread(len(group), share)
    )


def _spread(count: int, wanted: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, wanted).astype(int)).tolist()


def _panels(dataset: Dataset, identity: int, poses: list[int], hue: str) -> list[Panel | str]:
    """The meshes of an identity, words where the dataset has none."""
    there = set(dataset.grid.poses_of(identity).tolist())
    meshes = dict(zip(held := [pose for pose in poses if pose in there], dataset.vertices(identity, held), strict=True))
    faces, part = dataset.faces(identity), dataset.part(identity)
    colors = to_rgb(hue) if part is None else part_colors(part) / 255
    return [
        Panel(Mesh(standing(meshes[pose]), faces), colors) if pose in there else "not in the dataset" for pose in poses
    ]


def _appended(number: int, before: int) -> str:
    return ",\nappended" if number >= before else ""
