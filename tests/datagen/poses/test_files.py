"""Poses from files: AMASS motions and a file of one's own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.errors import RecipeError
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses, load_poses
from datagen.poses.amass import smpl_pose
from datagen.poses.files import read_pose_file, write_pose_file
from datagen.poses.skeletons import SMAL_JOINTS, SMAL_PARENTS
from datagen.recipe import PoseRecipe

STANDING = np.array([np.pi / 2, 0, 0])  # AMASS: Z up, so who stands is SMPL's rest pose turned a quarter about x


def recipe_of(path: Path, name: str = "file", *, seen: int = 4, unseen: int = 2, **options: Any) -> PoseRecipe:
    values = {"seen": seen, "unseen": unseen, "distribution": {"name": name, "path": str(path), **options}}
    return PoseRecipe.model_validate(values)


def motion(path: Path, *, frames: int = 10, width: int = 156, mark: float = 0.0) -> Path:
    """A motion whose left hip turns by ``mark`` about x and by the frame's number / 100 about y."""
    poses = np.zeros((frames, width))
    poses[:, :3] = STANDING
    poses[:, 3], poses[:, 4] = mark, np.arange(frames) / 100
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
    recipe = recipe_of(motions(tmp_path, 5), "amass", seen=200, unseen=0)
    drawn = hips(recipe, range(200))
    assert set(drawn[:, 0]) == {1, 2, 3, 4, 5}
    assert set(np.round(drawn[:, 1] * 100)) == set(range(10))
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
    drawn = draw_poses(recipe_of(tmp_path, "amass"), range(30)).rotations[:, 1:22].reshape(30, 63)
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
    recipe = recipe_of(folder, "amass", seen=300, unseen=300, held_out=0.3)
    seen, unseen = set(hips(recipe, range(300))[:, 0]), set(hips(recipe, range(300, 600))[:, 0])
    assert len(seen) == 7 and len(unseen) == 3 and not seen & unseen
    shared = recipe_of(folder, "amass", seen=300, unseen=300)
    assert set(hips(shared, range(300))[:, 0]) == set(hips(shared, range(300, 600))[:, 0]) == seen | unseen
    with pytest.raises(RecipeError, match=r"held-out motions .* cannot get more poses"):
        draw_poses(recipe, range(600, 601))


def test_a_motion_that_is_added_does_not_change_sides_with_another(tmp_path: Path) -> None:
    few, more = motions(tmp_path / "few", 10), motions(tmp_path / "more", 11)
    sides = [
        set(hips(recipe_of(folder, "amass", seen=1, unseen=300, held_out=share), range(1, 301))[:, 0])
        for folder, share in ((few, 0.5), (more, 5 / 11))
    ]
    assert len(sides[0]) == len(sides[1]) == 5 and len(sides[0] & sides[1]) >= 4


def test_files_without_poses_are_passed_over_and_the_asset_tells_content(tmp_path: Path) -> None:
    folder = motions(tmp_path / "a", 3)
    np.savez(folder / "subject0" / "shape.npz", betas=np.zeros(16))
    np.savez(folder / "subject0" / "neutral_stagei.npz", markers=np.zeros(4))
    asset = load_poses(recipe_of(folder, "amass")).assets[0]
    same = load_poses(recipe_of(motions(tmp_path / "b", 3), "amass")).assets[0]
    assert asset == same and asset.name == "AMASS motions (3 files)"
    motion(tmp_path / "c" / "subject1" / "walk_1_poses.npz", mark=2.0 + 1e-12)
    motion(tmp_path / "c" / "subject0" / "walk_0_poses.npz", mark=1.0)
    motion(tmp_path / "c" / "subject2" / "walk_2_poses.npz", mark=3.0)
    assert load_poses(recipe_of(tmp_path / "c", "amass")).assets[0].version != asset.version


def test_a_single_motion_file(tmp_path: Path) -> None:
    path = motion(tmp_path / "one.npz", mark=0.5)
    assert set(hips(recipe_of(path, "amass"), range(20))[:, 0]) == {0.5}
    with pytest.raises(RecipeError, match=r"held_out=0.5 of 1 motion files leaves none"):
        load_poses(recipe_of(path, "amass", held_out=0.5))


def test_motions_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"no motions at '.*nowhere'"):
        load_poses(recipe_of(tmp_path / "nowhere", "amass"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecipeError, match=r"no \.npz file with `poses` \(of 0"):
        load_poses(recipe_of(tmp_path / "empty", "amass"))
    (tmp_path / "torn.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(RecipeError, match=r"torn\.npz is no \.npz file"):
        load_poses(recipe_of(tmp_path / "torn.npz", "amass"))
    with pytest.raises(RecipeError, match=r"wide\.npz: poses have shape \(10, 90\)"):
        draw_poses(recipe_of(motion(tmp_path / "wide.npz", width=90), "amass"), range(1))
    with pytest.raises(RecipeError, match=r"nan\.npz: 10 frames are not finite, the first is 0"):
        draw_poses(recipe_of(motion(tmp_path / "nan.npz", mark=np.nan), "amass"), range(1))
    with pytest.raises(RecipeError, match=r"none\.npz: poses have shape \(0, 156\)"):
        draw_poses(recipe_of(motion(tmp_path / "none.npz", frames=0), "amass"), range(1))


def test_a_motion_that_changed_on_disk_is_not_read_in_silence(tmp_path: Path) -> None:
    path = motion(tmp_path / "one.npz", frames=500)
    content = bytearray(path.read_bytes())
    content[300_000] ^= 1
    path.write_bytes(content)
    with pytest.raises(RecipeError, match=r"cannot be read as a motion .*CRC"):
        draw_poses(recipe_of(path, "amass"), range(1))


def test_pickles_are_never_loaded(tmp_path: Path) -> None:
    evil = np.array([{"a": 1}], dtype=object)
    np.savez(tmp_path / "evil.npz", poses=evil, joints=np.array(["pelvis"]))
    with pytest.raises(RecipeError, match="cannot be read as a motion"):
        draw_poses(recipe_of(tmp_path / "evil.npz", "amass"), range(1))
    with pytest.raises(RecipeError, match=r"no \.npz file of plain arrays"):
        load_poses(recipe_of(tmp_path / "evil.npz"))


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
    write_pose_file(tmp_path / "p.npz", Poses(("pelvis",), (-1,), np.zeros((5, 1, 3))))
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
        ({"poses": np.full((6, 1, 3), np.inf), "joints": np.array(["pelvis"])}, "6 poses are not finite"),
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
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(RecipeError, match=r"text\.npz is no \.npz file"):
        load_poses(recipe_of(tmp_path / "text.npz"))
    np.save(tmp_path / "array.npy", np.zeros((6, 24, 3)))
    with pytest.raises(RecipeError, match=r"array\.npy is no \.npz file"):
        load_poses(recipe_of(tmp_path / "array.npy"))
