"""The template of an outfit: learning it as occupancy, and taking its surface (FITE, Lin et al. 2022, section 3.2)."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, binary_cross_entropy_with_logits

from datagen.common.errors import TrainingError
from datagen.mesh.geometry import edges_of, vertex_normals
from datagen.mesh.surface_nets import surface_nets
from training.avatar.diffusion import SkinningField, box_cells
from training.avatar.occupancy import FrameSamples
from training.checkpoints.tensor_record import TensorRecord

Network = Callable[[Tensor, Tensor], Tensor]
"""Logits [b, n] from points [b, n, 3] and poses [b, condition] (:class:`training.networks.template`)."""
_SHARPNESS = 5.0
_BARELY = 0.1  # share of its own distance to the surface by which a cell is moved across it
_SMOOTHED = (0.5, 0.6, 0.7, 0.8, 1.0)  # cells: widths of the Gaussian by which handles are closed
_AT_ONCE = 2**15  # points whose logits are computed together


@dataclass(frozen=True, eq=False)
class Template(TensorRecord):
    """The canonical surface of an outfit, whose vertices are the points of the avatar.

    ``vertices`` [v, 3] float32, metres; ``faces`` [f, 3] int64; unit ``normals`` [v, 3]; ``weights`` [v, bone].
    """

    kind = "template"
    vertices: Tensor
    faces: Tensor
    normals: Tensor
    weights: Tensor

    @property
    def euler_characteristic(self) -> int:
        """Vertices - edges + faces: two for each closed piece without a handle."""
        return _euler_characteristic(self.vertices.numpy(), self.faces.numpy())


def pose_condition(rotations: NDArray[np.float64]) -> Tensor:
    """What the network is told of poses [frame, joint, 3]: axis-angles but the root's over pi, [frame, 3 joint - 3]."""
    return torch.from_numpy(rotations[:, 1:].reshape(len(rotations), -1) / np.pi).float()


def plainest_pose(conditions: Tensor) -> Tensor:
    """The pose [condition] of least L1 norm among some [frame, condition]: the template is extracted under it."""
    return conditions[conditions.abs().sum(dim=1).argmin()]


def template_loss(network: Network, samples: FrameSamples, condition: Tensor, hands: tuple[Tensor, Tensor]) -> Tensor:
    """Cross entropy of occupancy, of points around scans and, where there are any, around the hands of the body.

    A posed point is occupied by the mean over its roots of sigmoid f, weighted by a softmax of five times themselves.
    Points without a root are left out. The mean over a frame's points, then over frames. ``samples`` have a leading
    axis b of frames, as ``condition`` [b, condition]; ``hands``: canonical points [m, 3] and whether they are inside
    [m].
    """
    found = samples.valid.any(dim=2)
    logits = network(samples.roots.flatten(1, 2), condition).reshape(samples.valid.shape)[found]
    occupied = logits.sigmoid()
    scores = (_SHARPNESS * occupied).masked_fill(~samples.valid[found], -torch.inf)
    mean = (scores.softmax(dim=1) * occupied).sum(dim=1)
    each = binary_cross_entropy(mean.clamp(1e-6, 1 - 1e-6), samples.inside[found].to(mean), reduction="none")
    of_frame = each.new_zeros(len(found)).index_add(0, found.nonzero()[:, 0], each) / found.sum(dim=1).clamp(min=1)
    loss = of_frame.mean()
    points, inside = hands
    if not len(points):
        return loss
    on_hands = network(points.expand(len(condition), -1, -1), condition)
    return loss + binary_cross_entropy_with_logits(on_hands, inside.to(on_hands).expand_as(on_hands))


@torch.no_grad()
def near_surface_iou(network: Network, samples: FrameSamples, condition: Tensor) -> float:
    """Intersection over union of what is inside and what is said to be, among the points near the surfaces of scans.

    A point is occupied if the network says so of any of its roots; one without a root is outside. Arguments as in
    :func:`template_loss`.
    """
    logits = network(samples.roots.flatten(1, 2), condition).reshape(samples.valid.shape)
    occupied = ((logits > 0) & samples.valid).any(dim=2)[samples.near]
    inside = samples.inside[samples.near]
    return float((occupied & inside).sum() / (occupied | inside).sum())


def extract_template(network: Network, condition: Tensor, field: SkinningField, *, cell: float = 0.015) -> Template:
    """The surface where the logit is zero under a pose, within the field's box: closed, a manifold, of one piece.

    Where it has handles, as fingers that touch, the logits, cut off at one, are smoothed by up to a cell until it has
    none, or left as they are.

    Parameters
    ----------
    condition
        The pose [condition] (:func:`plainest_pose`).
    cell
        Metres between places at which the network is asked, which is about how far vertices lie from one another: for
        a person 15 mm give some 13,000 vertices, 7 mm 55,000.

    Raises
    ------
    TrainingError
        The network has no surface in the box.
    """
    counts = np.ceil((field.high - field.low).numpy() / cell).astype(int).clip(3)
    places = torch.from_numpy(box_cells(field.low.numpy(), field.high.numpy(), tuple(counts.tolist()))).float()
    logits = _logits(network, places.reshape(-1, 3), condition).reshape(places.shape[:3]).numpy().transpose(2, 1, 0)
    outside = np.full(logits.shape, np.abs(logits).max())
    outside[1:-1, 1:-1, 1:-1] = -logits[1:-1, 1:-1, 1:-1]
    if not (outside < 0).any():
        raise TrainingError("the template has no surface: nothing is occupied in the field's box. Train for longer")
    at, faces = _without_handles(outside.astype(np.float64))
    edge = ((field.high - field.low).numpy() / counts).astype(np.float64)
    vertices = field.low.numpy() + (at + 0.5) * edge
    points = torch.from_numpy(vertices).float()
    normals = torch.from_numpy(vertex_normals(vertices, faces)).float()
    return Template(points, torch.from_numpy(faces), normals, field.weights(points))


def _without_handles(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The surface of values [i, j, k], negative inside, smoothed no more than it takes; else as it is."""
    whole = one_piece(values)
    smoothed = (ndimage.gaussian_filter(whole.clip(-1, 1), width) for width in _SMOOTHED)
    as_it_is = surface_nets(whole)
    surfaces = (surface_nets(one_piece(each)) for each in smoothed if (each < 0).any())
    return next((each for each in chain([as_it_is], surfaces) if _euler_characteristic(*each) == 2), as_it_is)


def _euler_characteristic(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> int:
    return len(vertices) - len(edges_of(faces)) + len(faces)


@torch.no_grad()
def _logits(network: Network, points: Tensor, condition: Tensor) -> Tensor:
    firsts = range(0, len(points), _AT_ONCE)
    return torch.cat([network(points[None, first : first + _AT_ONCE], condition[None])[0] for first in firsts])


def one_piece(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values [i, j, k], negative inside, with signs changed so that what is inside is one piece whose surface is a
    manifold: smaller pieces and cavities go, and where cells inside touch by an edge or a corner alone those between
    are filled.

    A surface through cells that touch so has edges with four faces, or vertices where two sheets meet.
    """
    inside = _largest(values < 0, touching=3)
    while True:
        filled = ~_largest(~(inside | _between(inside)))
        if (filled == inside).all():
            break
        inside = filled
    changed = inside != (values < 0)
    return np.where(changed, -_BARELY * values, values)


def _largest(cells: NDArray[np.bool_], *, touching: int = 1) -> NDArray[np.bool_]:
    """The largest set of cells that hang together: by their faces (1), or also by edges (2) and corners (3)."""
    labels, _ = ndimage.label(cells, ndimage.generate_binary_structure(3, touching))
    return labels == np.bincount(labels[cells]).argmax()


def _between(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The cells of blocks of 2 x 2 or 2 x 2 x 2 in which two opposite ones alone are inside, or alone outside."""
    found = np.zeros_like(inside)
    for shape in ((1, 2, 2), (2, 1, 2), (2, 2, 1), (2, 2, 2)):
        corners = list(np.ndindex(*shape))
        blocks = np.stack([_shifted(inside, corner, shape) for corner in corners])
        for start, corner in enumerate(corners[: len(corners) // 2]):
            end = corners.index(tuple(size - 1 - at for size, at in zip(shape, corner, strict=True)))
            opposite = blocks[start] & blocks[end]
            others = np.delete(blocks, [start, end], axis=0)
            touching = (opposite & ~others.any(axis=0)) | (~blocks[start] & ~blocks[end] & others.all(axis=0))
            for each in corners:
                _shifted(found, each, shape)[touching] = True
    return found


def _shifted(cells: NDArray[np.bool_], corner: tuple[int, ...], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """The view of cells that stand at a corner of every block of a shape."""
    steps = zip(corner, shape, cells.shape, strict=True)
    return cells[tuple(slice(at, count - size + 1 + at) for at, size, count in steps)]
