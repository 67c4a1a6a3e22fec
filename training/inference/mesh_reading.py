"""What networks are given of meshes: vertices in their boxes, and what is near along surfaces, where they take that.

A parts network reads meshes through a low-pass filter: vertices move twice towards the middle of those that edges join
them with, and nearly as far away again (Taubin, "A signal processing approach to fair surface design", 1995), so that
noise goes and limbs keep their size. What is posed are the vertices as they are.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor, nn

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, bounding_box, edges_of
from training.networks.layers.surface import Surface, joined, surface_of
from training.networks.parts import Parts, ReadTarget

_THERE, _BACK, _TIMES = 0.5, 0.53, 2
_NEIGHBOURS = 8
"""Of a vertex without edges, as of points, that are taken to be near it along the surface."""


def takes_surfaces(network: nn.Module) -> bool:
    """Whether a network is told what is near along the surfaces of its meshes (`training.networks.NETWORKS`)."""
    return bool(getattr(network, "takes_surfaces", False))


def surfaces_of(network: nn.Module, *, sources: Sequence[Mesh], targets: Sequence[Mesh]) -> dict[str, Surface]:
    """What a network takes beside the vertices of meshes: keyword arguments, none for the networks of the papers."""
    if not takes_surfaces(network):
        return {}
    device = next(network.parameters()).device
    return {
        "source_surface": surface_of_meshes(sources).to(device),
        "target_surface": surface_of_meshes(targets).to(device),
    }


def surface_of_meshes(meshes: Sequence[Mesh]) -> Surface:
    """What is near along the surfaces of meshes."""
    return joined([surface_of(mesh.vertices, _edges(mesh)) for mesh in meshes])


def boxed(network: nn.Module, meshes: Sequence[Mesh], *, as_read: bool = False) -> Tensor:
    """Vertices [b, n, 3] of meshes of n vertices each in their normalised boxes, where the network is.

    ``as_read``: through the low-pass filter, in the boxes of the meshes as they are.
    """
    boxes = [bounding_box(mesh.vertices) for mesh in meshes]
    vertices = [smoothed(mesh) if as_read else mesh.vertices for mesh in meshes]
    stacked = np.stack([box.normalise(each).astype(np.float32) for box, each in zip(boxes, vertices, strict=True)])
    return torch.from_numpy(stacked).to(next(network.parameters()).device)


@torch.no_grad()
def read_targets(network: Parts, targets: Sequence[Mesh]) -> ReadTarget:
    """Return targets of as many vertices each as a parts network reads them."""
    surface = surface_of_meshes(targets).to(next(network.parameters()).device)
    return network.read_target(boxed(network, targets), surface, as_read=boxed(network, targets, as_read=True))


@torch.no_grad()
def posed_like(network: Parts, sources: Sequence[Mesh], targets: ReadTarget, surface: Surface | None = None) -> Tensor:
    """Return targets [b, n, 3] in boxes of their own, in the poses of sources of as many vertices each.

    ``surface``: of the sources, where it is known.
    """
    read = [Mesh(smoothed(mesh), mesh.faces) for mesh in sources]
    surface = surface or surface_of_meshes(sources).to(targets.vertices.device)
    return network.posed_target(boxed(network, read), targets, surface)


def smoothed(mesh: Mesh) -> NDArray[np.float64]:
    """Vertices [n, 3] of a mesh without what changes from each to the next; those on open borders stay."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    count = len(vertices)
    ahead = csr_array((np.ones(3 * len(faces)), (faces.T.ravel(), np.roll(faces, -1, 1).T.ravel())), (count, count))
    sides = (ahead + ahead.T).tocsr()  # how many faces each edge has
    row = np.repeat(np.arange(count), np.diff(sides.indptr))
    free = (np.bincount(row, sides.data == 1, count) == 0) & (np.diff(sides.indptr) > 0)
    mean = csr_array((1 / np.diff(sides.indptr)[row], sides.indices, sides.indptr), (count, count))
    for _ in range(_TIMES):
        for share in (_THERE, -_BACK):
            vertices = vertices + np.where(free[:, None], share * (mean @ vertices - vertices), 0)
    return vertices


def _edges(mesh: Mesh) -> NDArray[np.int64]:
    """Edges [e, 2] of a mesh; vertices without any have some to those that are nearest."""
    edges = edges_of(mesh.faces)
    alone = np.setdiff1d(np.arange(len(mesh.vertices)), edges)
    if not len(alone):
        return edges
    return np.concatenate([edges, _to_nearest(mesh.vertices, alone)])


def _to_nearest(vertices: Floats, some: NDArray[np.int64]) -> NDArray[np.int64]:
    nearest = cKDTree(vertices).query(vertices[some], min(_NEIGHBOURS + 1, len(vertices)))[1].reshape(len(some), -1)
    edges = np.stack([np.repeat(some, nearest.shape[1]), nearest.ravel()], axis=1)
    return np.unique(np.sort(edges[edges[:, 0] != edges[:, 1]], axis=1), axis=0)
