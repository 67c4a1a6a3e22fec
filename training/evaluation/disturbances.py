"""What can be wrong with a source mesh: noise, missing parts, another sampling, another rotation (paper, Figure 9).

Every disturbance is a pure function ``(mesh, amount, seed) -> mesh``: the vertices [v, 3] in any unit, Y up, the same
seed the same bits; more of the amount is more of the same draw. The mesh that was given is never changed. Amount 0
gives it back as it was. The papers' networks see vertices only, so a disturbance may return no faces at all.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from datagen.mesh.geometry import Mesh, bounding_box, edges_of

Disturb = Callable[[Mesh, float, int], Mesh]
NO_FACES: NDArray[np.int64] = np.empty((0, 3), np.int64)
_FEWEST = 3  # vertices that are always left


@dataclass(frozen=True)
class Disturbance:
    """One way to disturb a source, and how much of it is tried.

    Attributes
    ----------
    name
        In rows and on the command line.
    heading, unit, words
        What a person reads: over a panel, along its axis, and of one amount.
    amounts
        Ascending, the first one 0 (nothing is done).
    apply
        The function.
    keeps_count
        Whether the vertices stay as many, in their order.
    changes_nothing
        Whether the normalisation before a network takes it away again, so that the output must be the same.
    even
        Whether a figure sets the amounts at equal steps rather than to scale.
    """

    name: str
    heading: str
    unit: str
    words: str
    amounts: tuple[float, ...]
    apply: Disturb
    keeps_count: bool = True
    changes_nothing: bool = False
    even: bool = False


def add_noise(mesh: Mesh, amount: float, seed: int) -> Mesh:
    """Add normal noise to every coordinate; the amount is its standard deviation in half the longest box edge."""
    scale = amount * float(bounding_box(mesh.vertices).half)
    return Mesh(mesh.vertices + scale * _random(seed).standard_normal(mesh.vertices.shape), mesh.faces)


def remove_patch(mesh: Mesh, amount: float, seed: int) -> Mesh:
    """Remove one connected patch, that share (0 to 1) of all vertices: those nearest along edges to a random vertex."""
    count = len(mesh.vertices)
    removed = min(round(amount * count), count - _FEWEST)
    distances = _along_edges(mesh, start=int(_random(seed).integers(count)))
    return _restricted(mesh, np.sort(np.argsort(distances, kind="stable")[removed:]))


def cut_side(mesh: Mesh, amount: float, seed: int) -> Mesh:
    """Cut off what lies beyond a plane across X; the amount is how far inwards it goes: 0 the tip, 1 the box's middle.

    +X is a body's left, so that the left hand goes first, then the arm. The seed plays no part.
    """
    low, high = mesh.vertices[:, 0].min(), mesh.vertices[:, 0].max()
    return _restricted(mesh, np.flatnonzero(mesh.vertices[:, 0] <= high - amount * (high - low) / 2))


def drop_vertices(mesh: Mesh, amount: float, seed: int) -> Mesh:
    """Drop that share (0 to 1) of the vertices, drawn at random; what is left is points without faces."""
    if not amount:
        return mesh
    count = len(mesh.vertices)
    kept = max(round((1 - amount) * count), min(_FEWEST, count))
    return Mesh(mesh.vertices[np.sort(_random(seed).permutation(count)[:kept])], NO_FACES)


def merge_cells(mesh: Mesh, amount: float, seed: int) -> Mesh:
    """Decimate by vertex clustering: one vertex, the mean, for each cell of a grid.

    The amount is the cells' side in half the longest box edge; the grid begins at the box's corner, whatever the seed.
    Faces of fewer than three clusters go.
    """
    if not amount:
        return mesh
    vertices = np.asarray(mesh.vertices, np.float64)
    cells = np.floor((vertices - vertices.min(0)) / (amount * float(bounding_box(vertices).half))).astype(np.int64)
    owner = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    sizes = np.bincount(owner)
    means = np.stack([np.bincount(owner, axis) / sizes for axis in vertices.T], axis=1)
    faces = owner[mesh.faces]
    a, b, c = faces.T
    return Mesh(means, faces[(a != b) & (b != c) & (c != a)])


def resample_by_area(mesh: Mesh, amount: float, seed: int) -> Mesh:
    """Replace the vertices by random points of the surface, even by area, ``amount`` times as many (0: as it was).

    What is left is points without faces, as dense everywhere.
    """
    areas = _areas(mesh)
    return _scattered(mesh, amount, seed, areas / areas.sum()) if amount else mesh


def resample_by_face(mesh: Mesh, amount: float, seed: int) -> Mesh:
    """As :func:`resample_by_area`, but with as many points on every face: dense where the mesh is dense."""
    return _scattered(mesh, amount, seed, np.full(len(mesh.faces), 1 / len(mesh.faces))) if amount else mesh


def subdivide(mesh: Mesh, amount: float, seed: int) -> Mesh:
    """Split every triangle into four at its edges' middles, ``amount`` (whole) times; the surface stays the same."""
    for _ in range(round(amount)):
        mesh = _split(mesh)
    return mesh


def turn(axis: str) -> Disturb:
    """The disturbance that turns a mesh by degrees, right-handed about an axis (x, y or z) through its box's centre."""

    def turned(mesh: Mesh, amount: float, seed: int) -> Mesh:
        centre = bounding_box(mesh.vertices).centre
        rotation = Rotation.from_euler(axis, amount, degrees=True).as_matrix()
        return Mesh((mesh.vertices - centre) @ rotation.T + centre, mesh.faces)

    return turned


def rescale(mesh: Mesh, amount: float, seed: int) -> Mesh:
    """Multiply all coordinates by ten to the power of the amount (3: metres become millimetres)."""
    return Mesh(mesh.vertices * 10.0**amount, mesh.faces)


def shift(mesh: Mesh, amount: float, seed: int) -> Mesh:
    """Move along all three axes by the amount, in half the longest box edge."""
    return Mesh(mesh.vertices + amount * float(bounding_box(mesh.vertices).half), mesh.faces)


_POINTS, _TIMES = "points / vertices", "{:g} times as many"
_DEGREES = (0, 10, 20, 30, 45, 60, 90, 135, 180)

DISTURBANCES: tuple[Disturbance, ...] = (
    Disturbance("noise", "Noise", "std, half box edges", "std {:g}", (0, 0.01, 0.02, 0.04, 0.06, 0.08, 0.1), add_noise),
    Disturbance(
        "patch", "Missing patch", "share removed", "{:g} of it", (0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5), remove_patch, False
    ),
    Disturbance(
        "side",
        "Left side cut off",
        "tip (0) to middle (1)",
        "{:g} of the way in",
        (0, 0.1, 0.2, 0.4, 0.6, 0.8),
        cut_side,
        False,
    ),
    Disturbance(
        "subset",
        "Vertices dropped",
        "share dropped",
        "{:g} of them",
        (0, 0.25, 0.5, 0.75, 0.9, 0.95),
        drop_vertices,
        False,
    ),
    Disturbance(
        "cells",
        "Decimated",
        "cell, half box edges",
        "cells of {:g}",
        (0, 0.03, 0.06, 0.1, 0.15, 0.2),
        merge_cells,
        False,
    ),
    Disturbance(
        "area", "Points by area", _POINTS, _TIMES, (0, 0.25, 0.5, 1, 2, 4, 8), resample_by_area, False, even=True
    ),
    Disturbance(
        "face", "Points by face", _POINTS, _TIMES, (0, 0.25, 0.5, 1, 2, 4, 8), resample_by_face, False, even=True
    ),
    Disturbance("subdivide", "Subdivided", "times", "{:g} times", (0, 1, 2), subdivide, False),
    Disturbance("turn-x", "Turned about X", "degrees (leans)", "{:g}°", _DEGREES, turn("x")),
    Disturbance("turn-y", "Turned about Y", "degrees (faces)", "{:g}°", _DEGREES, turn("y")),
    Disturbance("turn-z", "Turned about Z", "degrees (tips)", "{:g}°", _DEGREES, turn("z")),
    Disturbance("scale", "Scaled", "powers of ten", "10^{:g}", (0, 1, 2, 3), rescale, changes_nothing=True),
    Disturbance("shift", "Moved", "half box edges", "by {:g}", (0, 1, 10, 100), shift, changes_nothing=True, even=True),
)
"""All disturbances, in the order of tables and figures."""


def _random(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def _areas(mesh: Mesh) -> NDArray[np.float64]:
    """Twice the area [f] of every face."""
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces]
    return np.asarray(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1))


def _scattered(mesh: Mesh, amount: float, seed: int, chances: NDArray[np.float64]) -> Mesh:
    """Random points, evenly spread within faces that are drawn with the given chances [f]."""
    random, count = _random(seed), max(round(amount * len(mesh.vertices)), _FEWEST)
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces[random.choice(len(mesh.faces), count, p=chances)]]
    first, second = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1 - first, first * (1 - second), first * second], axis=1)  # uniform over a triangle
    return Mesh((weights[:, :, None] * corners).sum(axis=1), NO_FACES)


def _along_edges(mesh: Mesh, *, start: int) -> NDArray[np.float64]:
    """Length [v] of the shortest way along edges from a vertex; infinite to other components."""
    edges, count = edges_of(mesh.faces), len(mesh.vertices)
    lengths = np.linalg.norm(mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]], axis=1)
    graph = scipy.sparse.coo_array((np.maximum(lengths, 1e-12), tuple(edges.T)), shape=(count, count))
    return np.asarray(dijkstra(graph.tocsr(), directed=False, indices=start))


def _restricted(mesh: Mesh, kept: NDArray[np.integer]) -> Mesh:
    """The mesh of some of its vertices [k], ascending, and the faces that have all three of them."""
    place = np.full(len(mesh.vertices), -1)
    place[kept] = np.arange(len(kept))
    faces = place[mesh.faces]
    return Mesh(mesh.vertices[kept], faces[(faces >= 0).all(axis=1)])


def _split(mesh: Mesh) -> Mesh:
    edges, faces, count = edges_of(mesh.faces), mesh.faces.astype(np.int64), len(mesh.vertices)
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
    keys = edges[:, 0] * count + edges[:, 1]  # ascending, as edges are sorted
    middle = count + np.searchsorted(keys, sides[..., 0] * count + sides[..., 1])
    (a, b, c), (ab, bc, ca) = faces.T, middle.T
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    vertices = np.concatenate([mesh.vertices, mesh.vertices[edges].mean(axis=1)])
    return Mesh(vertices, np.concatenate([np.stack(each, axis=1) for each in quarters]))
