"""What the implicit template learns from: points around posed scans, whether they are inside, and where they come from.

A scan is the body and the parts of the outfit as posed meshes. A point is inside where the generalised winding number
of any of them is above one half; so a skirt is a solid tube, as in scans whose holes were closed.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, vertex_normals
from training.avatar.body import CanonicalBody
from training.avatar.diffusion import SkinningField
from training.avatar.roots import TransformField, canonical_roots, starting_bones
from training.avatar.solid import Solid

_BLUR = 0.025  # metres
_FREE = 8  # one such point for so many near the surface
HIDDEN_DEPTH = 0.004
"""Metres within another part, from which a point of a surface counts as hidden."""
_HAND_BLURS = (0.005, 0.03)  # metres; with the first alone hands grow where nothing is said of what is around them


class FrameSamples(NamedTuple):
    """Points around one scan.

    Attributes
    ----------
    roots, valid
        Up to three canonical places [n, 3, 3] of each, and which of them count [n, 3].
    inside
        Whether each is inside [n].
    near
        Whether each was drawn near the surface [n] of the scan, not as a canonical place.
    """

    roots: Tensor
    valid: Tensor
    inside: Tensor
    near: Tensor


def frame_samples(
    random: np.random.Generator,
    scan: Sequence[Mesh],
    *,
    body: CanonicalBody,
    field: SkinningField,
    transforms: NDArray[np.float64],
    count: int = 5000,
) -> FrameSamples:
    """Points around a scan with labels and canonical places.

    Places on hands do not count near the surface: hands are finer than the field. Of canonical places in the field's
    box those count which the pose moves 25 mm or more out of the scan. They need no root to be found, and reach where
    no posed point near a scan comes from: above the head, beyond the feet.

    Parameters
    ----------
    scan
        Posed body and parts of the outfit, facing outwards.
    transforms
        Of the pose [bone, 3, 4] (:meth:`CanonicalBody.transforms`).
    count
        Points near the surface; an eighth as many more are canonical places, uniform in the field's box.
    """
    moved, bones = torch.from_numpy(transforms).float(), starting_bones(body)
    deformation = TransformField.of(field, moved)
    _, points, _ = _on_surface(random, scan, count)
    points += random.normal(0, _BLUR, points.shape)
    roots, valid = canonical_roots(deformation, torch.from_numpy(points).float(), moved, bones)
    on_hand = field.weights(roots.reshape(-1, 3))[:, torch.from_numpy(body.hands)].sum(dim=1).reshape(valid.shape)
    low, high = field.low.numpy(), field.high.numpy()
    places = torch.from_numpy(random.uniform(low, high, (count // _FREE, 3))).float()
    free = torch.from_numpy(_depth_in_any(scan, deformation.posed(places).numpy()) < -_BLUR)
    themselves = torch.zeros(len(free), roots.shape[1], dtype=torch.bool)
    themselves[:, 0] = free
    return FrameSamples(
        torch.cat([roots, places[:, None].expand(-1, roots.shape[1], -1)]),
        torch.cat([valid & (on_hand < 0.5), themselves]),
        torch.cat([torch.from_numpy(inside_any(scan, points)), torch.zeros_like(free)]),
        torch.arange(count + len(free)) < count,
    )


def inside_any(scan: Sequence[Mesh], points: Floats) -> NDArray[np.bool_]:
    """Whether points [n, 3] are inside of any of some meshes [n]."""
    return _depth_in_any(scan, points) > 0


def _depth_in_any(scan: Sequence[Mesh], points: Floats) -> NDArray[np.float32]:
    depths = [Solid(mesh.vertices, mesh.faces).depth(points) for mesh in scan]
    return np.max(depths, axis=0)


def hand_samples(random: np.random.Generator, body: CanonicalBody, count: int) -> tuple[Tensor, Tensor]:
    """Canonical points [n, 3] around the body's hands, and whether each is inside the body [n]; none without hands.

    What scans cannot say of hands, the body does: vertices moved along their normals by N(0, 5 mm), as in the released
    code, and as many by N(0, 30 mm).
    """
    hands = np.flatnonzero(body.weights[:, body.hands].sum(axis=1) > 0.5)
    chosen = random.choice(hands, count if len(hands) else 0)
    normals = vertex_normals(body.vertices, body.faces)[chosen]
    along = random.standard_normal(len(chosen)) * np.resize(_HAND_BLURS, len(chosen))
    points = body.vertices[chosen] + along[:, None] * normals
    inside = Solid(body.vertices, body.faces).inside(points) if len(points) else np.empty(0, bool)
    return torch.from_numpy(points).float(), torch.from_numpy(inside)


def surface_points(
    random: np.random.Generator, scan: Sequence[Mesh], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points [n, 3] of a scan's outer surface, uniform by area, with unit normals [n, 3] of their faces.

    Of ``count`` points on all parts those that lie deeper than 4 mm within another part are left out.
    """
    part, points, normals = _on_surface(random, scan, count)
    hidden = np.zeros(len(points), bool)
    for number, mesh in enumerate(scan):
        others = np.flatnonzero(part != number)
        hidden[others] |= Solid(mesh.vertices, mesh.faces).depth(points[others]) > HIDDEN_DEPTH
    return points[~hidden], normals[~hidden]


def _on_surface(
    random: np.random.Generator, scan: Sequence[Mesh], count: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Numbers of parts [n], points [n, 3] and normals [n, 3] of a uniform draw over the area of all parts."""
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in scan]).astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(across, axis=1)
    faces = random.choice(len(corners), count, p=doubled / doubled.sum())
    shares = random.dirichlet((1, 1, 1), count)
    of_face = np.repeat(np.arange(len(scan)), [len(mesh.faces) for mesh in scan])
    return of_face[faces], (shares[..., None] * corners[faces]).sum(axis=1), (across / doubled[:, None])[faces]
