"""How far an avatar is from scans, in millimetres and degrees, and by the released definitions (FITE, ECCV 2022).

Surfaces are compared by area-uniform samples of them. With q the vertices of the model, n theirs normals, g the samples
of the scan, and nn the nearest sample:

===================  ===========================================================  ========
scan_to_model        mean over g of the distance to the model's surface           mm
model_to_scan        mean over q of the distance to the scan's surface            mm
plane                mean over q of |(g_nn - q) . n_nn|                           mm
normal_angle         mean over q of the angle between n and n_nn                  degrees
hausdorff            the largest distance of samples to the other surface         mm
chamfer              half the sum of both mean squared distances of samples to    diagonal
                     the other surface, in diagonals of the scan's box            squared
cosine               half the sum of the absolute values of both mean cosines     none
                     between normals of samples and of the nearest sample
===================  ===========================================================  ========

The last two are those of the released code, which makes a surface of the model's points and normals before it measures;
ours has faces, and its samples have the normals n between its vertices. Figures depend on the number of samples:
compare those of one number only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from datagen.common.arrays import Floats, Integers
from datagen.mesh.geometry import Mesh, closest_on_triangle

_NEAR = 8  # samples whose triangles may be the nearest
_MM = 1000.0


@dataclass(frozen=True, eq=False)
class Surface:
    """Area-uniform samples of a mesh.

    Attributes
    ----------
    mesh
        What was sampled, in metres.
    points, normals
        Of the samples ``[n, 3]``; normals are those of their triangles, or between those of the vertices.
    faces
        Number of each sample's triangle ``[n]``.
    """

    mesh: Mesh
    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    faces: NDArray[np.int64]

    @classmethod
    def sampled(cls, mesh: Mesh, count: int, *, normals: Floats | None = None, seed: int = 0) -> Surface:
        """Return ``count`` samples of a mesh, whose vertices may have normals ``[vertex, 3]`` of length one."""
        random = np.random.default_rng(seed)
        corners = np.asarray(mesh.vertices, np.float64)[mesh.faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(across, axis=1)
        faces = random.choice(len(areas), size=count, p=areas / areas.sum())
        first, second = np.sqrt(random.random(count)), random.random(count)
        shares = np.stack([1 - first, first * (1 - second), first * second], axis=1)
        points = (shares[:, :, None] * corners[faces]).sum(axis=1)
        of_faces = across[faces] / areas[faces, None]
        if normals is None:
            return cls(mesh, points, of_faces, faces)
        between = (shares[:, :, None] * np.asarray(normals, np.float64)[mesh.faces[faces]]).sum(axis=1)
        return cls(mesh, points, between / np.linalg.norm(between, axis=1, keepdims=True).clip(1e-12), faces)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)

    def nearest(self, points: Floats) -> NDArray[np.int64]:
        """The number [p] of the sample that is nearest to each of points ``[p, 3]``."""
        return np.asarray(self._tree.query(points)[1], np.int64)

    def closest(self, points: Floats) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The triangle [p] nearest to each of points ``[p, 3]``, and where on it, barycentric ``[p, 3]``.

        Of the triangles of the eight nearest samples, so that it is exact where samples are dense.
        """
        near = self.faces[self._tree.query(points, min(_NEAR, len(self.points)))[1]].reshape(len(points), -1)
        corners = np.asarray(self.mesh.vertices, np.float64)[self.mesh.faces[near]]
        shares = closest_on_triangle(points[:, None], corners)
        away = np.linalg.norm((shares[..., None] * corners).sum(axis=2) - points[:, None], axis=2)
        best = away.argmin(axis=1)[:, None]
        return np.take_along_axis(near, best, 1)[:, 0], np.take_along_axis(shares, best[..., None], 1)[:, 0]

    def distances(self, points: Floats) -> NDArray[np.float64]:
        """Distances [p] of points ``[p, 3]`` from the surface, in metres (:meth:`closest`)."""
        face, shares = self.closest(points)
        corners = np.asarray(self.mesh.vertices, np.float64)[self.mesh.faces[face]]
        away: NDArray[np.float64] = np.linalg.norm((shares[..., None] * corners).sum(axis=1) - points, axis=1)
        return away


@dataclass(frozen=True)
class AvatarScores:
    """See the table of :mod:`training.avatar.metrics`; ``parts``: the first four for each part of the scan."""

    scan_to_model: float
    model_to_scan: float
    plane: float
    normal_angle: float
    hausdorff: float
    chamfer: float
    cosine: float
    parts: Mapping[int, tuple[float, float, float, float]]


def score(
    model: Mesh, normals: Floats, scan: Mesh, *, samples: int = 20_000, parts: Integers | None = None, seed: int = 0
) -> AvatarScores:
    """Return how far a model is from a scan.

    Parameters
    ----------
    model, scan
        In metres, in one frame.
    normals
        At the model's vertices ``[n, 3]``, of length one.
    samples
        Of each surface.
    parts
        Label ``[vertex]`` of each of the scan's vertices; what is nearest to a part counts as of it. None: no parts.
    """
    of_model = Surface.sampled(model, samples, normals=normals, seed=seed)
    of_scan = Surface.sampled(scan, samples, seed=seed)
    vertices = np.asarray(model.vertices, np.float64)
    here = of_scan.nearest(vertices)
    plane = np.abs(((of_scan.points[here] - vertices) * of_scan.normals[here]).sum(axis=1))
    angle = np.degrees(np.arccos(np.clip((of_scan.normals[here] * normals).sum(axis=1), -1, 1)))
    reached, away = of_model.distances(of_scan.points), of_scan.distances(vertices)
    of_part = dict[int, tuple[float, float, float, float]]()
    if parts is not None:
        labels = parts[np.asarray(scan.faces)[of_scan.faces, 0]]
        for part in np.unique(labels).tolist():
            own, its = labels == part, labels[here] == part
            of_part[part] = (_mm(reached[own]), _mm(away[its]), _mm(plane[its]), _mean(angle[its]))
    there = of_scan.distances(of_model.points)
    diagonal = float(np.linalg.norm(np.ptp(np.asarray(scan.vertices, np.float64), axis=0)))
    return AvatarScores(
        scan_to_model=_mm(reached),
        model_to_scan=_mm(away),
        plane=_mm(plane),
        normal_angle=_mean(angle),
        hausdorff=_MM * float(max(reached.max(), there.max())),
        chamfer=float((reached**2).mean() + (there**2).mean()) / (2 * diagonal**2),
        cosine=(abs(_mean_cosine(of_scan, of_model)) + abs(_mean_cosine(of_model, of_scan))) / 2,
        parts=of_part,
    )


@dataclass(frozen=True, eq=False)
class Footprints:
    """Places on a scan's surface that move with it: simulated scans share their vertices, so each is one bit of cloth.

    Attributes
    ----------
    corners
        Numbers of the scan's vertices ``[n, 3]``, of the triangle that a place lies on.
    shares
        Of these in the place, ``[n, 3]``.
    """

    corners: NDArray[np.int64]
    shares: NDArray[np.float64]

    @classmethod
    def of(cls, points: Floats, scan: Mesh) -> Footprints:
        """Those nearest to points ``[n, 3]``."""
        face, shares = Surface.sampled(scan, 4 * len(scan.faces)).closest(points)
        return cls(np.asarray(scan.faces, np.int64)[face], shares)

    def distances(self, points: Floats, vertices: Floats) -> NDArray[np.float64]:
        """Distances ``[n]`` of points ``[n, 3]`` from their places on the scan of another pose, in metres.

        The corresponding error: a point that slides over the cloth has one, however near to the surface it stays.
        """
        places = (self.shares[..., None] * np.asarray(vertices, np.float64)[self.corners]).sum(axis=1)
        away: NDArray[np.float64] = np.linalg.norm(np.asarray(points, np.float64) - places, axis=1)
        return away


def _mean_cosine(one: Surface, other: Surface) -> float:
    return _mean((one.normals * other.normals[other.nearest(one.points)]).sum(axis=1))


def _mm(metres: Floats) -> float:
    return _MM * _mean(metres)


def _mean(values: Floats) -> float:
    return float(values.mean()) if values.size else float("nan")
