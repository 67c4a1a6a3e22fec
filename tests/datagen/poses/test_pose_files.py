"""Poses from a file of one's own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.common.errors import RecipeError
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses, load_poses
from datagen.poses.pose_files import read_pose_file, write_pose_file
from datagen.poses.skeletons import SMAL_JOINTS, SMAL_PARENTS
from datagen.recipe import PoseRecipe


def recipe_of(path: Path, *, seen: int = 4, unseen: int = 2) -> PoseRecipe:
    values = {"seen": seen, "unseen": unseen, "distribution": {"name": "file", "path": str(path)}}
    return PoseRecipe.model_validate(values)


def test_poses_that_are_written_to_a_file_are_drawn_from_it(tmp_path: Path) -> None:
    npt = draw_poses(PoseRecipe(seen=4, unseen=2), range(6))
    write_pose_file(tmp_path / "npt.npz", npt)
    drawn = draw_poses(recipe_of(tmp_path / "npt.npz"), range(6))
    assert drawn.joints == npt.joints and drawn.parents == npt.parents
    assert drawn.rotations.tobytes() == npt.rotations.tobytes()
    first = (tmp_path / "npt.npz").read_bytes()
    write_pose_file(tmp_path / "npt.npz", npt)
    assert (tmp_path / "npt.npz").read_bytes() == first


def test_parents_of_known_names_need_not_be_given(tmp_path: Path) -> None:
    def parents(joints: tuple[str, ...]) -> tuple[int, ...]:
        np.savez(tmp_path / "p.npz", poses=np.zeros((1, len(joints), 3)), joints=np.array(joints))
        return read_pose_file(tmp_path / "p.npz").parents

    assert parents(JOINTS) == PARENTS and parents(SMAL_JOINTS) == SMAL_PARENTS
    assert parents(("pelvis", "left_knee", "left_foot", "head")) == (-1, 0, 1, 0)
    assert parents(("left_knee", "right_knee")) == (-1, -1)
    with pytest.raises(RecipeError, match=r"neither SMPL's nor SMAL's \('tentacle'\)"):
        parents(("pelvis", "tentacle"))
    with pytest.raises(RecipeError, match=r"joint 0 \('left_knee'\) has parent 1"):
        parents(("left_knee", "left_hip"))


def test_poses_over_a_few_joints_turn_a_body_as_the_full_tree_would(tmp_path: Path) -> None:
    full = np.zeros((1, 24, 3))
    full[0, JOINTS.index("pelvis")], full[0, JOINTS.index("left_knee")] = [0.1, 0.4, 0], [0.7, 0, 0]
    few = full[:, [0, JOINTS.index("left_knee")]]
    np.savez(tmp_path / "few.npz", poses=few, joints=np.array(["pelvis", "left_knee"]))
    world = read_pose_file(tmp_path / "few.npz").on(JOINTS, PARENTS)
    assert np.allclose(world, Poses(JOINTS, PARENTS, full).world(), atol=1e-5)


def test_too_few_poses_are_refused_with_the_counts(tmp_path: Path) -> None:
    write_pose_file(tmp_path / "p.npz", Poses(("pelvis",), (-1,), np.arange(15.0).reshape(5, 1, 3) / 9))
    with pytest.raises(RecipeError, match=r"asks for 6 poses \(4 seen \+ 2 unseen\), but .*p\.npz has 5"):
        load_poses(recipe_of(tmp_path / "p.npz"))
    with pytest.raises(RecipeError, match=r"asks for 6 poses, but .* has 5"):  # appended later
        draw_poses(recipe_of(tmp_path / "p.npz", seen=4, unseen=1), range(5, 6))


@pytest.mark.parametrize(
    "arrays, message",
    [
        ({"joints": np.array(["pelvis"])}, "has no array 'poses'; it has joints"),
        ({"poses": np.zeros((1, 1, 3))}, "has no array 'joints'"),
        ({"poses": np.zeros((6, 2, 3)), "joints": np.array(["pelvis"])}, r"`poses` has shape \(6, 2, 3\)"),
        ({"poses": np.zeros((6, 3)), "joints": np.array(["pelvis"])}, r"`poses` has shape \(6, 3\)"),
        ({"poses": np.full((6, 1, 3), "a"), "joints": np.array(["pelvis"])}, "must be numbers"),
        (
            {"poses": np.full((6, 1, 3), 1e300), "joints": np.array(["pelvis"])},
            "not finite, or far from any angle in radians: 6 poses, the first is number 0",
        ),
        (
            {"poses": [[[0, 0, 0]], [[0, 90, 0]]], "joints": np.array(["pelvis"])},
            r"pose 1 turns joint 0 \('pelvis'\) by 90, more than two turns .* are these degrees\? they must be radians",
        ),
        ({"poses": np.zeros((6, 1, 3)), "joints": np.array(["a"]), "parents": np.array(["b"])}, "whole numbers"),
        ({"poses": np.zeros((6, 1, 3)), "joints": np.array(["a"]), "parents": np.array([[-1, 0]])}, r"shape \(1, 2\)"),
        ({"poses": np.zeros((6, 1, 3)), "joints": np.array(["a"]), "parents": np.array([-1.5])}, "type float64"),
        ({"poses": np.zeros((6, 1, 3)), "joints": np.array([["a"]])}, r"`joints` has shape \(1, 1\)"),
        ({"poses": np.zeros((6, 1, 3)), "joints": np.array([b"a"])}, "`joints` has .* must be names"),
        ({"poses": np.full((6, 1, 3), np.inf), "joints": np.array(["pelvis"])}, "not finite"),
        ({"poses": np.zeros((6, 2, 3)), "joints": np.array(["head", "head"])}, "names 'head' twice"),
        ({"poses": np.zeros((6, 1, 3)), "joints": np.array(["a"]), "parents": np.array([-1, 0])}, "2 parents for 1"),
        ({"poses": np.zeros((6, 1, 3)), "joints": np.array(["a"]), "parents": np.array([0])}, "has parent 0"),
    ],
)
def test_pose_files_that_cannot_be_used(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    np.savez(tmp_path / "p.npz", **arrays)
    with pytest.raises(RecipeError, match=message):
        load_poses(recipe_of(tmp_path / "p.npz"))


def test_no_pose_file(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"no pose file at .*write_pose_file makes one"):
        load_poses(recipe_of(tmp_path / "none.npz"))
    np.save(tmp_path / "array.npy", np.zeros((6, 24, 3)))
    with pytest.raises(RecipeError, match=r"array\.npy is no \.npz file"):
        load_poses(recipe_of(tmp_path / "array.npy"))


def test_a_pose_cannot_be_seen_and_unseen(tmp_path: Path) -> None:
    rotations = np.arange(18.0).reshape(6, 1, 3)
    rotations[3:] /= 9
    rotations[1] = rotations[5] = [-0.0, 1, 2]
    rotations[5, 0, 0] = 0.0
    write_pose_file(tmp_path / "p.npz", Poses(("pelvis",), (-1,), rotations))
    with pytest.raises(RecipeError, match=r"p\.npz: pose 5 is to be unseen, but equals pose 0, which is seen"):
        load_poses(recipe_of(tmp_path / "p.npz"))
    assert len(draw_poses(recipe_of(tmp_path / "p.npz", unseen=1), range(5))) == 5
