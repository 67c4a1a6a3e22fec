"""Inside and outside of meshes, with holes or without, and what is seen of them."""

import numpy as np
import pytest
import trimesh

from datagen.mesh.geometry import vertex_normals
from training.avatar.solid import Solid


def test_depth_in_a_sphere_is_the_distance_to_its_surface() -> None:
    mesh = trimesh.creation.icosphere(3)
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = np.linspace(0.1, 2, 200)
    assert Solid(mesh.vertices, mesh.faces).depth(radius[:, None] * directions) == pytest.approx(1 - radius, abs=0.02)


def test_an_open_tube_is_filled() -> None:
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    first, second = np.arange(24), np.roll(np.arange(24), -1)
    faces = np.concatenate([np.stack([first, first + 24, second], 1), np.stack([second, first + 24, second + 24], 1)])
    tube = Solid(np.concatenate([ring, ring + np.array([0, 3, 0])]), faces)
    height = np.array([-1, 0.5, 1.5, 2.5, 4])
    assert tube.inside(np.stack([0 * height, height, 0 * height], axis=1)).tolist() == [False, True, True, True, False]


def test_a_cavity_is_not_seen() -> None:
    outer, inner = trimesh.creation.icosphere(2), trimesh.creation.icosphere(2)
    vertices = np.concatenate([outer.vertices, 0.5 * inner.vertices])
    faces = np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.vertices)])
    seen = Solid(vertices, faces).seen(vertices, vertex_normals(vertices, faces))
    assert seen[: len(outer.vertices)].all() and not seen[len(outer.vertices) :].any()
