"""Poses from AMASS: which frames are drawn, how bodies stand, and files that cannot be used."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.common.errors import RecipeError
from datagen.poses import JOINTS, draw_poses, load_poses
from datagen.poses.amass import smpl_pose
from datagen.recipe import PoseRecipe

STANDING = np.array([np.pi / 2, 0, 0])  # AMASS: Z up, so who stands is SMPL's rest pose turned a quarter about x


def recipe_of(path: Path, *, seen: int = 4, unseen: int = 2, held_out: float = 0.0, **options: Any) -> PoseRecipe:
    distribution = {"name": "amass", "path": str(path), "held_out": held_out, **options}
    return PoseRecipe.model_validate({"seen": seen, "unseen": unseen, "distribution": distribution})


def motion(path: Path, *, frames: int = 200, width: int = 156, mark: float = 0.0) -> Path:
    """A motion whose left hip turns by ``mark`` about x and by the frame's number / 1000 about y."""
    poses = np.zeros((frames, width))
    poses[:, :3] = STANDING
    poses[:, 3], poses[:, 4] = mark, np.arange(frames) / 1000
    path.parent.mkdir(parents=True, exist_ok=True)
    others = {"trans": np.zeros((frames, 3)), "betas": np.zeros(16), "mocap_framerate": np.array(120.0)}
    np.savez(path, allow_pickle=False, poses=poses, gender=np.array("male"), **others)
    return path


def motions(folder: Path, count: int) -> Path:
    for number in range(count):
        motion(folder / f"subject{number % 3}" / f"walk_{number}_poses.npz", mark=number + 1.0)
    return folder


def hips(recipe: PoseRecipe, poses: range) -> np.ndarray:
    return draw_poses(recipe, poses).rotations[:, JOINTS.index("left_hip")]


def test_a_pose_is_a_frame_of_some_motion(tmp_path: Path) -> None:
    recipe = recipe_of(motions(tmp_path, 5), seen=200, unseen=0)
    drawn = hips(recipe, range(200))
    assert set(drawn[:, 0]) == {1, 2, 3, 4, 5}
    assert all(len(rows) == 40 for rows in by_motion(drawn).values()), "motions weigh alike"
    assert np.ptp(drawn[:, 1]) > 0.15, "frames are of any time"
    assert np.array_equal(hips(recipe, range(7, 8))[0], drawn[7])
    other = hips(PoseRecipe.model_validate(recipe.model_dump() | {"seed": 1}), range(200))
    assert not np.array_equal(other, drawn)


@pytest.mark.parametrize("width, hands", [(66, False), (72, True), (156, False), (165, False)])
def test_smpl_joints_of_every_member_of_the_family(width: int, hands: bool) -> None:
    frame = np.arange(1, width + 1) / 100
    pose = smpl_pose(frame, root="drop")
    assert pose.shape == (24, 3) and not pose[0].any()
    assert np.array_equal(pose[1:22], frame[3:66].reshape(21, 3))
    assert np.array_equal(pose[22:], frame[66:72].reshape(2, 3) if hands else np.zeros((2, 3)))


def test_root_and_body_as_arrays_of_their_own(tmp_path: Path) -> None:
    body = np.linspace(-1, 1, 5 * 63).reshape(5, 63)
    np.savez(tmp_path / "run_stageii.npz", root_orient=np.tile(STANDING, (5, 1)), pose_body=body)
    drawn = draw_poses(recipe_of(tmp_path, seen=5, unseen=0), range(5)).rotations[:, 1:22].reshape(5, 63)
    assert {row.tobytes() for row in drawn} == {row.tobytes() for row in body}


def turn(axis: str, degrees: float) -> Rotation:
    return Rotation.from_euler(axis, degrees, degrees=True)


def root_of(rotation: Rotation, mode: str) -> Rotation:
    """The root rotation that comes of one in AMASS, where Z is up."""
    frame = np.concatenate([rotation.as_rotvec(), np.zeros(63)])
    return Rotation.from_rotvec(smpl_pose(frame, root=mode)[0])


@pytest.mark.parametrize("heading", [0, 50, 170, -120])
def test_who_stands_in_amass_stands_here_and_faces_z(heading: float) -> None:
    recorded = turn("z", heading) * Rotation.from_rotvec(STANDING)
    assert np.allclose(recorded.apply([0, 1, 0]), [0, 0, 1]), "heads are up in AMASS's own frame"
    assert np.allclose(root_of(recorded, "upright").as_matrix(), np.eye(3), atol=1e-8)
    assert np.allclose(root_of(recorded, "drop").as_matrix(), np.eye(3))
    kept = root_of(recorded, "keep")
    assert np.allclose(kept.apply([0, 1, 0]), [0, 1, 0], atol=1e-8)
    assert np.allclose(kept.as_matrix(), turn("y", heading).as_matrix(), atol=1e-8)


@pytest.mark.parametrize("heading", [0, 35, -160])
@pytest.mark.parametrize("lean", [turn("x", 40), turn("z", -25), turn("x", 90), turn("x", -90), turn("x", 120)])
def test_upright_keeps_how_a_body_leans_or_lies(heading: float, lean: Rotation) -> None:
    """Bowing, bending aside, lying on the belly and on the back, head down: whatever the heading was."""
    recorded = turn("z", heading) * Rotation.from_rotvec(STANDING) * lean
    assert np.allclose(root_of(recorded, "upright").as_matrix(), lean.as_matrix(), atol=1e-7)


def test_held_out_motions_give_unseen_poses_and_no_others(tmp_path: Path) -> None:
    folder = motions(tmp_path, 10)
    recipe = recipe_of(folder, seen=300, unseen=300, held_out=0.3)
    seen, unseen = set(hips(recipe, range(300))[:, 0]), set(hips(recipe, range(300, 600))[:, 0])
    assert len(seen) == 7 and len(unseen) == 3 and not seen & unseen
    shared = recipe_of(folder, seen=300, unseen=300)
    assert set(hips(shared, range(300))[:, 0]) == set(hips(shared, range(300, 600))[:, 0]) == seen | unseen
    assert set(hips(recipe, range(600, 900))[:, 0]) == unseen, "poses that are appended are unseen ones"
    with pytest.raises(
        RecipeError, match=r"601 poses .* from the 3 motion files held out for unseen .* have 600 frames"
    ):
        draw_poses(recipe, range(900, 901))


def test_a_motion_that_is_added_does_not_change_sides_with_another(tmp_path: Path) -> None:
    few, more = motions(tmp_path / "few", 10), motions(tmp_path / "more", 11)
    sides = [
        set(hips(recipe_of(folder, seen=1, unseen=300, held_out=share), range(1, 301))[:, 0])
        for folder, share in ((few, 0.5), (more, 5 / 11))
    ]
    assert len(sides[0]) == len(sides[1]) == 5 and len(sides[0] & sides[1]) >= 4


def test_files_without_poses_are_passed_over_and_the_asset_tells_content(tmp_path: Path) -> None:
    folder = motions(tmp_path / "a", 3)
    np.savez(folder / "subject0" / "shape.npz", betas=np.zeros(16))
    np.savez(folder / "subject0" / "neutral_stagei.npz", markers=np.zeros(4))
    asset = load_poses(recipe_of(folder)).assets[0]
    same = load_poses(recipe_of(motions(tmp_path / "b", 3))).assets[0]
    assert asset == same and asset.name == "AMASS motions (3 files)"
    motion(tmp_path / "c" / "subject1" / "walk_1_poses.npz", mark=2.0 + 1e-12)
    motion(tmp_path / "c" / "subject0" / "walk_0_poses.npz", mark=1.0)
    motion(tmp_path / "c" / "subject2" / "walk_2_poses.npz", mark=3.0)
    assert load_poses(recipe_of(tmp_path / "c")).assets[0].version != asset.version


def test_a_single_motion_file(tmp_path: Path) -> None:
    path = motion(tmp_path / "one.npz", mark=0.5)
    assert set(hips(recipe_of(path), range(20))[:, 0]) == {0.5}
    with pytest.raises(RecipeError, match=r"held_out=0.5 of 1 motion files leaves none"):
        load_poses(recipe_of(path, held_out=0.5))


def test_motions_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"no motions at '.*nowhere'"):
        load_poses(recipe_of(tmp_path / "nowhere"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecipeError, match=r"no \.npz file with `poses` \(of 0"):
        load_poses(recipe_of(tmp_path / "empty"))
    with pytest.raises(RecipeError, match=r"wide\.npz: poses have shape \(200, 90\)"):
        draw_poses(recipe_of(motion(tmp_path / "wide.npz", width=90)), range(1))
    with pytest.raises(RecipeError, match=r"nan\.npz: not finite.*200 frames, the first is 0"):
        draw_poses(recipe_of(motion(tmp_path / "nan.npz", mark=np.nan)), range(1))
    with pytest.raises(RecipeError, match=r"none\.npz: poses have shape \(0, 156\)"):
        draw_poses(recipe_of(motion(tmp_path / "none.npz", frames=0)), range(1))


def test_a_motion_that_changed_on_disk_is_not_read_in_silence(tmp_path: Path) -> None:
    path = motion(tmp_path / "one.npz", frames=500)
    content = bytearray(path.read_bytes())
    content[300_000] ^= 1
    path.write_bytes(content)
    with pytest.raises(RecipeError, match=r"cannot be read as a motion .*CRC"):
        draw_poses(recipe_of(path), range(1))


def by_motion(drawn: np.ndarray) -> dict[float, list[float]]:
    found: dict[float, list[float]] = {}
    for mark, frame, _ in drawn.tolist():
        found.setdefault(mark, []).append(frame)
    return found


def test_no_frame_is_drawn_twice_and_all_are_drawn(tmp_path: Path) -> None:
    for mark, frames in ((1.0, 3), (2.0, 40), (3.0, 11)):
        motion(tmp_path / f"walk{mark}.npz", frames=frames, mark=mark)
    recipe = recipe_of(tmp_path, seen=30, unseen=24)
    drawn = hips(recipe, range(54))
    assert len({row.tobytes() for row in drawn}) == 54
    assert {mark: len(rows) for mark, rows in by_motion(drawn[:9]).items()} == {1.0: 3, 2.0: 3, 3.0: 3}
    assert [int(mark) for mark in drawn[-29:, 0]] == [2] * 29, "the longest has frames when others have none"
    with pytest.raises(RecipeError, match=r"55 poses .* from the 3 motion files there, which have 54 frames"):
        load_poses(recipe_of(tmp_path, seen=30, unseen=25))
    with pytest.raises(RecipeError, match=r"55 poses .* which have 54 frames"):
        draw_poses(recipe, range(54, 55))


def test_some_motions_are_held_out_unless_said_otherwise(tmp_path: Path) -> None:
    values = {"seen": 100, "unseen": 100, "distribution": {"name": "amass", "path": str(motions(tmp_path, 10))}}
    drawn = hips(PoseRecipe.model_validate(values), range(200))[:, 0]
    assert len(set(drawn[:100])) == 8 and len(set(drawn[100:])) == 2 and not set(drawn[:100]) & set(drawn[100:])


def test_numbers_that_are_no_angles(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"far\.npz: not finite, or far from any angle: 200 frames"):
        draw_poses(recipe_of(motion(tmp_path / "far.npz", mark=1e300)), range(1))
