"""Rigid parts: rotations from what a network says of them, and where joints go."""

from __future__ import annotations

import re
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import normalize


def rotations_from_six(numbers: Tensor) -> Tensor:
    """Return rotations [..., 3, 3] whose first two columns are [..., 6] made orthonormal (Zhou et al. 2019)."""
    first = normalize(numbers[..., :3], dim=-1)
    second = numbers[..., 3:] - (first * numbers[..., 3:]).sum(dim=-1, keepdim=True) * first
    second = normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def matrices(numbers: Tensor) -> Tensor:
    """Return matrices [..., 3, 3] of their rows one after another [..., 9]."""
    return numbers.reshape(*numbers.shape[:-1], 3, 3)


def box(vertices: Tensor) -> tuple[Tensor, Tensor]:
    """Return the middle [b, 1, 3] and half the longest edge [b, 1, 1] of the boxes of vertices [b, n, 3]."""
    low, high = vertices.amin(dim=1, keepdim=True), vertices.amax(dim=1, keepdim=True)
    return (low + high) / 2, ((high - low) / 2).amax(dim=2, keepdim=True).clamp_min(1e-6)


def about_vertical(cosine: Tensor, sine: Tensor) -> Tensor:
    """Return rotations [..., 3, 3] about Y, from +Z to +X, by the cosines and sines [...] of their angles."""
    zero = torch.zeros_like(cosine)
    return matrices(torch.stack([cosine, zero, sine, zero, zero + 1, zero, -sine, zero, cosine], dim=-1))


def turned_about(vectors: Tensor) -> Tensor:
    """Return rotations [b, 3, 3] about vectors [b, 3], by their lengths in radians (Rodrigues)."""
    x, y, z = vectors.unbind(1)
    zero, angle = torch.zeros_like(x), vectors.norm(dim=1)[:, None, None]
    across = matrices(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1))
    turn, back = torch.sinc(angle / torch.pi), torch.sinc(angle / (2 * torch.pi)).square() / 2
    return torch.eye(3, dtype=vectors.dtype, device=vectors.device) + turn * across + back * (across @ across)


def halved(rotations: Tensor) -> Tensor:
    """Return rotations [..., 3, 3] by half of their angles, which are below 180 degrees.

    The unit quaternion of half of it lies midway between that of the rotation and that of none.
    """
    ahead = (1 + rotations.diagonal(dim1=-2, dim2=-1).sum(-1)).clamp_min(1e-12).sqrt() / 2  # cosine of half the angle
    across = (rotations - rotations.mT) / (4 * ahead)[..., None, None]  # by the vector of the quaternion
    ahead = 1 + ahead
    norm = ahead.square() + across.square().sum((-2, -1)) / 2
    none = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
    return none + (2 / norm)[..., None, None] * (ahead[..., None, None] * across + across @ across)


def nearest_rotations(spread: Tensor) -> Tensor:
    """Return the rotations [b, 3, 3] by which points p come nearest to points q; sum q p^T [b, 3, 3] (Kabsch 1976).

    Those of points that are not numbers are none.
    """
    left, _, right = torch.linalg.svd(spread.nan_to_num(0, 0, 0))
    flip = torch.linalg.det(left @ right).sign()
    left = left * torch.stack([torch.ones_like(flip), torch.ones_like(flip), flip], dim=1)[:, None]
    return left @ right + spread.sum((1, 2), keepdim=True) * 0


def other_side(names: Sequence[str]) -> Tensor | None:
    """Return the number of each part's mirror image [part], as left and right in their names say.

    None where no name says so, or the part on the other side is missing.
    """
    opposite = {"left": "right", "right": "left"}
    images = [re.sub("left|right", lambda side: opposite[side[0]], name) for name in names]
    if images == list(names) or not set(images) <= set(names):
        return None
    return torch.tensor([names.index(image) for image in images])


def mirrored(rotations: Tensor) -> Tensor:
    """Return the mirror images [..., 3, 3] of rotations [..., 3, 3], of left and right, which are along X."""
    signs = rotations.new_tensor([-1.0, 1.0, 1.0])
    return signs[:, None] * rotations * signs


def skinned(vertices: Tensor, weights: Tensor, turns: Tensor, joints: Tensor, moved: Tensor) -> Tensor:
    """Return vertices [b, n, 3] by linear blend skinning, weights [b, n, part].

    Each part is turned [b, part, 3, 3] about its joint [b, part, 3], which goes to ``moved`` [b, part, 3].
    """
    shift = moved - (turns @ joints[..., None])[..., 0]
    blended = weights @ torch.cat([turns.flatten(2), shift], dim=2)
    return (matrices(blended[..., :9]) @ vertices[..., None])[..., 0] + blended[..., 9:]


def ancestors(parents: Sequence[int]) -> Tensor:
    """Return [part, part] float32: 1 where the second is the first or above it; a root's parent is -1."""
    above = torch.eye(len(parents))
    for part, parent in enumerate(parents):
        if parent >= 0:
            above[part] += above[parent]
    return above


def hanging_on(parents: Sequence[int]) -> Tensor:
    """Return [part, part] float32: 1 where the second is the first, or hangs on it; a root's parent is itself."""
    own = torch.eye(len(parents))
    return own.maximum(own[list(parents)].mT)


def moved_joints(joints: Tensor, rotations: Tensor, parents: Tensor, above: Tensor) -> Tensor:
    """Return where joints [b, part, 3] go when every part is turned [b, part, 3, 3] about its own; roots stay.

    Parameters
    ----------
    parents
        [part] int64, a root's is itself.
    above
        :func:`ancestors`.
    """
    bones = joints - joints[:, parents]
    turned = (rotations[:, parents] @ bones[..., None])[..., 0]
    is_root = parents == torch.arange(len(parents), device=parents.device)
    return above.to(joints.dtype) @ torch.where(is_root[:, None], joints, turned)
