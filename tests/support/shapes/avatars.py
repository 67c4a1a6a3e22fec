"""Small canonical templates and poses of theirs: spheres on two bones."""

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from datagen.mesh.geometry import Mesh
from training.avatar.maps import Views
from training.networks.avatar import CanonicalPoints, PointAvatar

SIZES = {"map_size": 16, "unet_width": 2, "hidden_width": 16, "geometry": 8, "pose": 8}


def sphere(*, radius: float = 0.5, subdivisions: int = 2) -> Mesh:
    """A sphere about the origin: 162 vertices by default."""
    its = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Mesh(np.asarray(its.vertices, np.float64), np.asarray(its.faces, np.int64))


def noisy(mesh: Mesh, deviation: float) -> Mesh:
    """A mesh whose vertices are moved by noise of a standard deviation, the same each time."""
    return Mesh(mesh.vertices + np.random.default_rng(0).normal(0, deviation, mesh.vertices.shape), mesh.faces)


def weights_of(mesh: Mesh) -> torch.Tensor:
    """Weights [n, 2]: the lower bone's fade upwards into the upper's."""
    upper = np.clip(mesh.vertices[:, 1] + 0.5, 0, 1)
    return torch.from_numpy(np.stack([1 - upper, upper], axis=1)).float()


def template_of(mesh: Mesh, views: Views | None = None) -> CanonicalPoints:
    """A sphere's template."""
    places = (views or Views.of([mesh.vertices])).places(mesh.vertices)[..., :2]
    points = torch.from_numpy(mesh.vertices).float()
    return CanonicalPoints(
        points, torch.nn.functional.normalize(points, dim=1), weights_of(mesh), torch.from_numpy(places)
    )


def bent(degrees: float, *, shift: float = 0.0) -> np.ndarray:
    """Transforms [2, 3, 4] of the bones: the upper one bent about X, both shifted along X."""
    turns = Rotation.from_rotvec([[0, 0, 0], [degrees, 0, 0]], degrees=True).as_matrix()
    return np.concatenate([turns, np.tile([[[shift], [0], [0]]], (2, 1, 1))], axis=2)


def avatar(*meshes: Mesh, normalisation: str = "group", seed: int = 0) -> PointAvatar:
    """A small avatar of such templates."""
    torch.manual_seed(seed)
    views = Views.of([mesh.vertices for mesh in meshes])
    return PointAvatar([template_of(mesh, views) for mesh in meshes], normalisation=normalisation, **SIZES)
