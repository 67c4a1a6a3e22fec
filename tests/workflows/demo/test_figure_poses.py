"""Poses of made-up bodies: random ones, those of a file, and joints turned by hand."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.common.errors import MeshError
from datagen.poses import JOINTS, PARENTS, Poses
from datagen.poses.pose_files import write_pose_file
from datagen.poses.skeletons import SMAL_JOINTS, SMAL_PARENTS
from workflows.demo import poses as demo_poses
from workflows.demo.poses import PERSON, TURNED, Pose, poses_of, read_poses

HIP = JOINTS.index("left_hip")


def amass(path: Path, **others: Any) -> Path:
    """Ninety frames that stand with Z up and bend the left hip by as many hundredths."""
    frames = np.zeros((90, 156))
    frames[:, 0] = np.pi / 2
    frames[:, 3 * HIP] = np.arange(90) / 100
    np.savez(path, **({"poses": frames} | others))
    return path


def test_turns_come_on_top_of_the_pose_about_the_parents_axes() -> None:
    bare = poses_of(PERSON, Pose(3.0)).rotations[0]
    turned = poses_of(PERSON, Pose(3.0, turns=(("left_hip", (0.0, 0.0, 90.0)),))).rotations[0]
    expected = Rotation.from_rotvec([0, 0, np.pi / 2]) * Rotation.from_rotvec(bare[HIP])
    assert np.allclose(turned[HIP], expected.as_rotvec())
    assert np.array_equal(np.delete(turned, HIP, axis=0), np.delete(bare, HIP, axis=0))


def test_at_rest_nothing_is_turned_but_what_is_said() -> None:
    assert not poses_of(PERSON, Pose()).rotations.any()
    turned = poses_of(PERSON, Pose(turns=(("head", (-30.0, 0.0, 0.0)),))).rotations[0]
    assert np.degrees(turned[JOINTS.index("head")]).round(6).tolist() == [-30, 0, 0]
    assert set(TURNED.values()) <= set(JOINTS)


def test_a_motion_is_played_at_the_pages_rate_from_the_chosen_frame_on(tmp_path: Path) -> None:
    file = read_poses(amass(tmp_path / "walk.npz", mocap_framerate=np.array(60.0)))
    assert (file.name, file.count, file.apart) == ("walk", 90, 4)
    frames = Pose(10.0, file).on_the_way()
    assert [pose.number for pose in frames] == list(range(10, 90, 4))
    assert np.allclose(poses_of(PERSON, frames[1]).rotations[0, HIP], [0.14, 0, 0])
    assert not poses_of(PERSON, frames[1]).rotations[0, 0].any()  # upright


def test_poses_of_named_joints_are_all_played_and_can_be_turned(tmp_path: Path) -> None:
    rotations = np.random.default_rng(0).uniform(-1, 1, (5, len(JOINTS), 3))
    write_pose_file(tmp_path / "own.npz", Poses(JOINTS, PARENTS, rotations))
    file = read_poses(tmp_path / "own.npz")
    frames = Pose(0.0, file, turns=(("head", (0.0, 5.0, 0.0)),)).on_the_way()
    assert len(frames) == 5 and frames[4].name == "own-4"
    drawn = poses_of(PERSON, frames[4]).rotations[0]
    assert np.allclose(drawn[HIP], rotations[4, HIP]) and not np.allclose(drawn[15], rotations[4, 15])
    assert np.array_equal(file.draw(4), rotations[4])  # the file's own stays


def refused(path: Path, content: dict[str, Any]) -> str:
    np.savez(path, **content)
    with pytest.raises(MeshError) as error:
        read_poses(path)
    return str(error.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"betas": np.zeros(16)}, "holds no poses: neither AMASS's"),
        ({"poses": np.zeros((4, 10))}, "poses have shape (4, 10)"),
        ({"poses": np.zeros((0, 24, 3)), "joints": np.array(JOINTS)}, "`poses` is empty"),
        ({"poses": np.zeros((1, 24, 3)), "joints": np.array(["a"] * 24)}, "names 'a' twice"),
        ({"poses": np.zeros((2, 35, 3)), "joints": np.array([f"{joint} of a dog" for joint in SMAL_JOINTS]),
          "parents": np.array(SMAL_PARENTS)}, "none of its joints is a person's"),
    ],
)  # fmt: skip
def test_what_holds_no_poses_of_a_person_is_refused_in_a_line(
    tmp_path: Path, content: dict[str, Any], said: str
) -> None:
    message = refused(tmp_path / "file.npz", content)
    assert said in message and "\n" not in message and "file.npz" in message


def test_more_than_the_page_keeps_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo_poses, "NUMBER_LIMIT", 100)
    monkeypatch.setattr(demo_poses, "find_motions", lambda _: pytest.fail("it was read"))
    assert "14,040 numbers of poses, the page takes 100" in refused(
        tmp_path / "long.npz", {"poses": np.zeros((90, 156))}
    )


def test_names_of_joints_fill_neither_memory_nor_the_page(tmp_path: Path) -> None:
    poses = np.zeros((1, 1, 3))
    long = refused(tmp_path / "long.npz", {"poses": poses, "joints": np.array(["x" * 50_000])})
    assert "bytes of names of joints, more than 100,000" in long
    assert len(refused(tmp_path / "named.npz", {"poses": poses, "joints": np.array(["x" * 20_000])})) < 600
