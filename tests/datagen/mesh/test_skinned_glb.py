"""Skinned GLB files: what is written poses as skinning says, read by the specification alone."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from datagen.mesh.files import read_mesh_file
from datagen.mesh.rig import part_transforms, skinned
from datagen.mesh.skinned_glb import Skeleton, four_influences, skinned_glb
from tests.support.shapes.skinned_files import SkinnedFile

SKELETON = Skeleton(
    ("root", "a", "b", "c", "d", "e"),
    (-1, 0, 1, 0, 3, -1),
    np.array([[0, 0, 0], [0, 1, 0], [0, 2, 0.5], [1, 0, 0], [2, 0, 0], [5.0, 5, 5]]),
)


@pytest.fixture
def written(tmp_path: Path) -> tuple[SkinnedFile, np.ndarray]:
    ball = trimesh.creation.icosphere(2)
    ball.export(tmp_path / "ball.obj")
    weights = np.random.default_rng(0).dirichlet(np.full(6, 0.5), len(ball.vertices))
    content, left_out = skinned_glb(read_mesh_file(tmp_path / "ball.obj"), SKELETON, weights)
    assert not left_out
    (tmp_path / "ball.glb").write_bytes(content)
    return SkinnedFile(tmp_path / "ball.glb"), weights


def test_only_the_four_largest_weights_are_kept() -> None:
    kept = four_influences(np.array([[0.1, 0.2, 0.25, 0.05, 0.4], [0.5, 0.5, 0, 0, 0]]))
    assert kept == pytest.approx(np.array([[0.1, 0.2, 0.25, 0, 0.4], [0.95 * 0.5, 0.95 * 0.5, 0, 0, 0]]) / 0.95)
    few = np.array([[0.3, 0.7]])
    assert np.array_equal(four_influences(few), few)


def test_at_rest_vertices_are_where_they_were(written: tuple[SkinnedFile, np.ndarray]) -> None:
    file, _ = written
    assert file.posed({}) == pytest.approx(np.asarray(file.positions), abs=1e-6)


def test_turned_joints_move_vertices_as_skinning_says(written: tuple[SkinnedFile, np.ndarray]) -> None:
    file, weights = written
    local = {name: Rotation.from_rotvec([0.3 * n, -0.2, 0.5]).as_matrix() for n, name in enumerate(SKELETON.names)}
    world = list[np.ndarray]()
    for name, parent in zip(SKELETON.names, SKELETON.parents, strict=True):
        world.append(local[name] if parent < 0 else world[parent] @ local[name])
    transforms = part_transforms(np.stack(world), SKELETON.joints, SKELETON.parents)
    expected = skinned(file.positions[: len(weights)], four_influences(weights), transforms[None])[0]
    assert file.posed(local)[: len(weights)] == pytest.approx(expected, abs=1e-5)


def test_a_joint_without_weight_is_number_0(written: tuple[SkinnedFile, np.ndarray]) -> None:
    file, _ = written
    assert file.weights.sum(axis=1) == pytest.approx(np.ones(len(file.weights)), abs=1e-6)
    assert not file.joints[file.weights == 0].any()


def test_a_mesh_of_two_bones_has_four_influences_all_the_same(tmp_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "box.ply")
    two = Skeleton(("a", "b"), (-1, 0), np.zeros((2, 3)))
    content, _ = skinned_glb(read_mesh_file(tmp_path / "box.ply"), two, np.tile([0.25, 0.75], (8, 1)))
    (tmp_path / "box.glb").write_bytes(content)
    file = SkinnedFile(tmp_path / "box.glb")
    assert file.joints.shape[1] == 4 and file.weights[0].tolist() == [0.75, 0.25, 0, 0]


def test_both_sides_of_a_seam_follow_the_same_bones(tmp_path: Path) -> None:
    (tmp_path / "seam.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 1\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt 0.5 0.5\nf 1/1 2/2 3/3\nf 1/5 3/3 4/4\nf 4/4 2/2 1/1\n"
    )
    weights = np.array([[0.9, 0.1], [0.2, 0.8], [0.5, 0.5], [0.0, 1.0]])
    two = Skeleton(("a", "b"), (-1, -1), np.zeros((2, 3)))
    content, left_out = skinned_glb(read_mesh_file(tmp_path / "seam.obj"), two, weights)
    (tmp_path / "seam.glb").write_bytes(content)
    file = SkinnedFile(tmp_path / "seam.glb")
    assert len(file.positions) == 5 and "1 vertices are written again" in left_out[0]
    assert np.array_equal(file.joints[4], file.joints[0]) and np.array_equal(file.weights[4], file.weights[0])
    assert np.array_equal(file.positions[4], file.positions[0])


def test_another_library_opens_it_and_joints_have_one_root(written: tuple[SkinnedFile, np.ndarray]) -> None:
    file, _ = written
    opened = trimesh.load(file.path, process=False).to_geometry()
    assert opened.vertices == pytest.approx(file.positions, abs=1e-6)
    root = file.json["nodes"][file.json["scenes"][0]["nodes"][1]]
    assert [file.json["nodes"][child]["name"] for child in root["children"]] == ["root", "e"]
