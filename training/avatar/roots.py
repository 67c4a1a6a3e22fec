"""Canonical points of posed ones: roots of W(x) = A(x) x by Newton's method from several starts (FITE, section 3.2).

A(x), the blend of the bones' transforms by the diffused weights at x, does not change with training, so that roots are
found once. Where the body touches itself a posed point has several.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from training.avatar.body import CanonicalBody
from training.avatar.diffusion import SkinningField, sampled

_STEP = 2e-3  # metres, of central differences
_LONGEST, _STEPS = 0.2, 20  # metres that an iterate moves at most, and how often
_CONVERGED, _LOST, _SAME = 1e-4, 1.0, 5e-3  # metres: a root; given up; two starts found one root
_KEPT = 3


@dataclass(frozen=True)
class TransformField:
    """How one pose moves the space around a canonical body: ``grid`` [12, z, y, x] of blended transforms in a box."""

    low: Tensor
    high: Tensor
    grid: Tensor

    @classmethod
    def of(cls, field: SkinningField, transforms: Tensor) -> "TransformField":
        """Of a field of weights and transforms [bone, 3, 4] from the canonical pose."""
        return cls(field.low, field.high, field.transforms(transforms))

    def matrices(self, points: Tensor) -> Tensor:
        """A(x) [n, 3, 4] at canonical points [n, 3]."""
        return sampled(self.grid, self.low, self.high, points).reshape(-1, 3, 4)

    def posed(self, points: Tensor) -> Tensor:
        """W(x) [n, 3] of canonical points [n, 3]."""
        matrices = self.matrices(points)
        return (matrices[..., :3] @ points[..., None])[..., 0] + matrices[..., 3]

    def jacobian(self, points: Tensor) -> Tensor:
        """dW/dx [n, 3, 3] by central differences."""
        steps = _STEP * torch.cat([torch.eye(3), -torch.eye(3)])
        ahead, behind = self.posed((points + steps[:, None]).reshape(-1, 3)).reshape(2, 3, -1, 3)
        return ((ahead - behind) / (2 * _STEP)).permute(1, 2, 0)

    def contains(self, points: Tensor) -> Tensor:
        """Whether points [..., 3] lie in the box [...]."""
        return ((points >= self.low) & (points <= self.high)).all(dim=-1)


class Roots(NamedTuple):
    """Canonical ``points`` [n, 3, 3] of n posed ones, best first, and which of them are ``valid`` [n, 3]."""

    points: Tensor
    valid: Tensor


def canonical_roots(field: TransformField, posed: Tensor, transforms: Tensor, starts: Tensor) -> Roots:
    """Up to three canonical points of each posed one.

    Parameters
    ----------
    field
        Of the pose.
    posed
        Points [n, 3].
    transforms
        Of the bones [bone, 3, 4], from the canonical pose.
    starts
        Numbers of the bones that a point may belong to rigidly, from which Newton's method starts
        (:func:`starting_bones`).
    """
    starts = starts[torch.arange(max(len(starts), _KEPT)) % len(starts)]
    chosen = transforms[starts].to(posed)
    begun = torch.linalg.solve(chosen[:, :, :3], (posed[:, None] - chosen[:, :, 3])[..., None])[..., 0]
    wanted = posed.repeat_interleave(len(starts), 0)
    points, errors = _newton(field, begun.reshape(-1, 3), wanted)
    return _distinct(field, points.reshape(begun.shape), errors.reshape(begun.shape[:2]))


def starting_bones(body: CanonicalBody, count: int = 9) -> Tensor:
    """Numbers of the bones that move most of a body's surface, in their order: more of them find hardly more roots."""
    corners = body.vertices[body.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    moved = areas @ body.weights[body.faces].mean(axis=1)
    return torch.from_numpy(np.sort(np.argsort(-moved, kind="stable")[:count]))


def _newton(field: TransformField, points: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """The best iterates [n, 3] and how far [n] from the wanted place each is posed."""
    points, best = points.clone(), points.clone()
    errors = torch.full((len(points),), torch.inf)
    live = torch.arange(len(points))
    for _ in range(_STEPS):
        offset = field.posed(points[live]) - wanted[live]
        error = offset.norm(dim=1)
        better = error < errors[live]
        errors[live[better]], best[live[better]] = error[better], points[live[better]]
        going = (error > _CONVERGED) & (error < _LOST)
        live, offset = live[going], offset[going]
        if not len(live):
            break
        points[live] -= _step(field.jacobian(points[live]), offset)
    return best, errors


def _step(jacobian: Tensor, offset: Tensor) -> Tensor:
    """Newton's step, no longer than some way; where space is folded flat the matrix is a little off."""
    step = torch.linalg.solve(jacobian + _CONVERGED * torch.eye(3), offset)
    return step * (_LONGEST / step.norm(dim=1, keepdim=True)).clamp(max=1)


def _distinct(field: TransformField, points: Tensor, errors: Tensor) -> Roots:
    """The best roots of each row [n, start, 3] that are in the box and differ from those before them."""
    valid = (errors < _CONVERGED) & field.contains(points)
    order = torch.where(valid, errors, torch.inf).argsort(dim=1, stable=True)
    points, valid = points.take_along_dim(order[..., None], 1), valid.take_along_dim(order, 1)
    near = torch.cdist(points, points) < _SAME
    again = torch.tril(near & valid[:, None], diagonal=-1).any(dim=2)
    valid &= ~again
    first = (~valid).to(torch.int8).argsort(dim=1, stable=True)[:, :_KEPT]
    return Roots(points.take_along_dim(first[..., None], 1), valid.take_along_dim(first, 1))


def fold_over(field: TransformField, cells: Tensor) -> Tensor:
    """Whether the pose turns space inside out at canonical points [n, 3]: det dW/dx <= 0."""
    return torch.linalg.det(field.jacobian(cells)) <= 0
