"""What a point avatar is trained by: distances to scans both ways, normals, and small corrections (FITE, ECCV 2022)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from datagen.mesh.geometry import edges_of
from training.networks.avatar import Avatar

_WEIGHTS = {
    "reached": 1e4,
    "plane": 1e4,
    "displacement": 2000.0,
    "correction": 400.0,
    "features": 1.0,
}
"""Those of the released code; lengths are in metres."""


class Scan(NamedTuple):
    """Points of a posed surface ``[n, 3]``, metres, and its normals there ``[n, 3]``, of length one."""

    points: Tensor
    normals: Tensor


class Edges(NamedTuple):
    """Which points of an outfit's template are neighbours.

    Attributes
    ----------
    ends
        Numbers of the points at both ends of each edge ``[e, 2]``.
    counts
        Neighbours of each point ``[n, 1]``, of one that has none 1.
    """

    ends: Tensor
    counts: Tensor

    @classmethod
    def of(cls, faces: NDArray[np.integer], count: int) -> Edges:
        """Those of triangles ``[f, 3]`` over so many points."""
        ends = torch.from_numpy(edges_of(faces))
        return cls(ends, torch.bincount(ends.flatten(), minlength=count).clamp_min(1)[:, None])

    def to(self, device: torch.device | str) -> Edges:
        """The same on another device."""
        return Edges(self.ends.to(device), self.counts.to(device))

    def roughness(self, values: Tensor) -> Tensor:
        """The mean over points of the distance between a point's value ``[n, 3]`` and the mean of its neighbours'."""
        first, second = self.ends.T
        sums = torch.zeros_like(values).index_add(0, first, values[second]).index_add(0, second, values[first])
        return (values - sums / self.counts).norm(dim=1).mean()


def avatar_loss(
    avatar: Avatar, scans: Sequence[Scan], *, normals: float, edges: Sequence[Edges] = (), roughness: float = 0.0
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the weighted loss and its parts, unweighted and detached.

    Means over the points of a frame, then over frames, whose numbers of points may differ: ``reached``, squared
    distances from scan points to the nearest avatar point; ``plane``, squared distances of avatar points from the
    tangent plane of the nearest scan point; ``normals``, absolute differences to its normal, by coordinate. And means
    of squares by coordinate: ``displacement``, ``correction``, ``features``.

    Where edges are told, ``roughness``: how far a point's offset from the skinned template is from the mean of its
    neighbours', in metres. It is no term of the paper's, whose points have no faces; without it, neighbours come to lie
    in disorder. It is no square, so that offsets may jump where skinning tears a skirt apart.

    Parameters
    ----------
    avatar
        As :class:`training.networks.avatar.PointAvatar` returns it.
    scans
        Of the same frames.
    normals
        Weight of the normals: released is 1e-6 in the first five eighths of a training, then 1.
    edges, roughness
        Of each frame's outfit, and the weight of their roughness; no edges: the paper's loss.

    Raises
    ------
    ValueError
        The numbers of frames differ.
    """
    if len(scans) != len(avatar.counts) or len(edges) not in (0, len(scans)):
        raise ValueError(f"{len(avatar.counts)} frames were given {len(scans)} scans and {len(edges)} times edges")
    counts = list(avatar.counts)
    frames = zip(torch.split(avatar.points, counts), torch.split(avatar.normals, counts), scans, strict=True)
    reached, plane, turned = torch.stack([torch.stack(_distances(*frame)) for frame in frames]).mean(dim=0)
    parts = {
        "reached": reached,
        "plane": plane,
        "normals": turned,
        "displacement": _by_frame(avatar.displacements, counts),
        "correction": _by_frame(avatar.corrections, counts),
        "features": _by_frame(avatar.features, counts),
    }
    if edges:
        offsets = torch.split(avatar.points - avatar.skinned, counts)
        parts["roughness"] = torch.stack(list(map(Edges.roughness, edges, offsets))).mean()
    weights = {**_WEIGHTS, "normals": normals, "roughness": roughness}
    loss = torch.stack([weights[name] * part for name, part in parts.items()]).sum()
    return loss, {name: part.detach() for name, part in parts.items()}


def nearest(queries: Tensor, points: Tensor) -> Tensor:
    """Return the number [q] of the point among ``[n, 3]`` that is nearest to each of ``[q, 3]``.

    By a k-d tree, which takes n log n time; on a GPU by all distances, which it has sooner than it could ask. Points as
    near as rounding tells may be taken for each other then. There is no gradient. What is not finite is taken to lie at
    the origin.
    """
    asked, there = (tensor.detach().nan_to_num(posinf=0, neginf=0) for tensor in (queries, points))
    if not asked.is_cuda:
        return torch.from_numpy(cKDTree(there.cpu().numpy()).query(asked.cpu().numpy())[1]).to(queries.device)
    some = asked.split(max(1, _DISTANCES // len(there)))  # type: ignore[no-untyped-call]
    return torch.cat([squared_distances(each, there).argmin(dim=1) for each in some])


_DISTANCES = 2**26
"""That are worked out at a time, with as many numbers again."""


def squared_distances(queries: Tensor, points: Tensor) -> Tensor:
    """Return [q, n] for ``[q, 3]`` and ``[n, 3]``, by differences: of near points products would leave rounding."""
    found = (queries[:, None, 0] - points[:, 0]).square_()
    for axis in (1, 2):
        found += (queries[:, None, axis] - points[:, axis]).square_()
    return found


def _distances(points: Tensor, normals: Tensor, scan: Scan) -> tuple[Tensor, Tensor, Tensor]:
    there, here = nearest(scan.points, points), nearest(points, scan.points)
    reached = (scan.points - points[there]).square().sum(dim=1)
    plane = ((scan.points[here] - points) * scan.normals[here]).sum(dim=1).square()
    return reached.mean(), plane.mean(), (normals - scan.normals[here]).abs().mean()


def _by_frame(values: Tensor, counts: list[int]) -> Tensor:
    return torch.stack([frame.square().mean() for frame in torch.split(values, counts)]).mean()
