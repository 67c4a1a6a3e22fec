"""Poses from animation clips: which clip, which moment, and on whose joints."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.bodies import load_body
from datagen.characters.character import load_character, load_characters
from datagen.common.errors import RecipeError
from datagen.mesh.geometry import edges_of
from datagen.poses import Poses, draw_poses, load_poses
from datagen.poses.animation_clips import ClipSource, shared_skeleton
from datagen.recipe import ClipPoses, PoseRecipe, RangePoses, RiggedBody
from tests.support.shapes.bodies import identity
from tests.support.shapes.real_animals import require_animals
from tests.support.shapes.rigged_files import BOXES, JOINTS, Floats, Rig, about


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two characters: one nods and waves a leg, one only nods, with other bones and one joint more."""
    person = Rig()
    person.clips = {
        "Nod": {"Head": person.keys("Head", [np.eye(3), about("y", 80)], [0.0, 2.0])},
        "Wave": {"Leg.L": person.keys("Leg.L", [np.eye(3), about("z", 60)], [1.0, 3.0])},
    }
    person.save(tmp_path / "person.glb")
    joints = JOINTS | {"Tail1": ("Hips", (0.0, 1.0, -0.1))}
    other = Rig(joints=joints, boxes=[*BOXES, ((-0.02, 0.98, -0.6), (0.02, 1.02, -0.1), "Tail1", "Tail1")])
    other.bones = "straight"
    other.clips = {"nod": {"Head": other.keys("Head", [np.eye(3), about("x", 20)], [0.0, 1.0])}}
    other.save(tmp_path / "devil.glb")
    return tmp_path


def source(folder: Path, *, seen: int = 400, seed: int = 0, **options: object) -> ClipSource:
    clips = ClipPoses.model_validate({"path": str(folder)} | options)
    return ClipSource(PoseRecipe(distribution=clips, seen=seen, seed=seed))


def turns(its: ClipSource, poses: range, joint: str) -> Floats:
    """Degrees by which each pose turns a joint, to 0.0001: files hold single precision."""
    number = its.joints.index(joint)
    return np.round(np.degrees(np.linalg.norm([its.draw(pose)[number] for pose in poses], axis=1)), 4)


def test_a_pose_is_a_function_of_its_number(folder: Path) -> None:
    one, other = source(folder, jitter=3.0), source(folder, jitter=3.0)
    backwards = [other.draw(pose) for pose in reversed(range(20))][::-1]
    for pose in range(20):
        assert np.array_equal(one.draw(pose), backwards[pose])
    assert not np.array_equal(one.draw(0), source(folder, jitter=3.0, seed=1).draw(0))


def test_clips_and_moments_are_uniform(folder: Path) -> None:
    """Three clips; within one, the angle grows evenly with time, so that it is uniform too."""
    its = source(folder)
    head, leg = turns(its, range(900), "Head"), turns(its, range(900), "Leg.L")
    waves = leg[leg > 0]
    assert len(waves) == pytest.approx(300, abs=45) and (head[leg > 0] == 0).all()
    assert waves.mean() == pytest.approx(30, abs=4) and waves.max() <= 60 + 1e-6
    assert (head > 20.001).sum() == pytest.approx(225, abs=45) and head.max() <= 80 + 1e-6


def test_joints_are_those_that_all_characters_share(folder: Path) -> None:
    its = source(folder)
    assert set(its.joints) == set(JOINTS) and its.draw(0).shape == (len(JOINTS), 3)
    assert "Tail1" in source(folder, characters=["devil"]).joints
    assert shared_skeleton(str(folder)) == (its.joints, its.parents)


def test_rotations_are_relative_to_the_parent_in_axes_of_the_rest_pose(tmp_path: Path) -> None:
    """The hips turn by 90 degrees about y, the leg hangs on them and turns by 40 about the turned x."""
    rig = Rig(bones="straight")
    rig.clips = {
        "Turn": {
            "Hips": rig.keys("Hips", [about("y", 90)], [0.0]),
            "Leg.L": rig.keys("Leg.L", [about("x", 40)], [0.0]),
        }
    }
    rig.save(tmp_path / "person.glb")
    its = source(tmp_path)
    expected = np.zeros((len(its.joints), 3))
    expected[its.joints.index("Hips")] = [0, np.radians(90), 0]
    expected[its.joints.index("Leg.L")] = [np.radians(40), 0, 0]
    assert np.abs(its.draw(0) - expected).max() < 1e-6


def test_a_clip_turns_other_characters_alike(folder: Path) -> None:
    """The other's bones have other axes; its leg swings as the first one's does."""
    its, person = source(folder), load_character(folder / "person.glb")
    poses = Poses(its.joints, its.parents, its.at(person, "Wave", 3.0)[None])
    moved = []
    for name in ("person", "devil"):
        body = load_body(RiggedBody(path=str(folder), characters=(name,), bone_scale=0.0))
        parameters = identity(body)
        still = Poses(its.joints, its.parents, np.zeros((1, len(its.joints), 3)))
        moved.append((body.vertices(parameters, poses) - body.vertices(parameters, still))[0, : 8 * len(BOXES)])
    assert np.abs(moved[0]).max() > 0.5 and np.abs(moved[0] - moved[1]).max() < 1e-5


def test_jitter_turns_every_joint_a_little_further(folder: Path) -> None:
    still, shaken = source(folder), source(folder, jitter=5.0)
    for pose in range(10):
        before, after = (Rotation.from_rotvec(each.draw(pose)) for each in (still, shaken))
        further = np.degrees((before.inv() * after).as_rotvec())
        assert np.abs(further).max() <= 5 + 1e-6 and (np.linalg.norm(further, axis=1) > 0).all()


class TestChoosingClips:
    """Patterns, and clips that are held out."""

    def test_patterns_whatever_their_case(self, folder: Path) -> None:
        its = source(folder, clips=["NOD*"])
        assert turns(its, range(60), "Leg.L").max() == 0 and turns(its, range(60), "Head").max() > 20

    def test_a_pattern_that_fits_nothing_names_the_clips(self, folder: Path) -> None:
        with pytest.raises(RecipeError, match=r"clips: no clip is called 'Jump\*'; there are Nod, Wave, nod"):
            source(folder, clips=["nod", "Jump*"])
        with pytest.raises(RecipeError, match="held_out: no clip is called 'Wave'; there are Nod, nod"):
            source(folder, clips=["nod"], held_out=["Wave"])

    def test_held_out_clips_are_for_unseen_poses_alone(self, folder: Path) -> None:
        its = source(folder, seen=50, held_out=["wave"])
        assert turns(its, range(50), "Leg.L").max() == 0
        assert turns(its, range(50, 100), "Leg.L").min() > 0 and turns(its, range(50, 100), "Head").max() == 0

    def test_holding_out_everything_is_refused(self, folder: Path) -> None:
        with pytest.raises(RecipeError, match="leaves no clip for the seen poses"):
            source(folder, held_out=["*"])

    def test_characters_without_clips_say_so(self, tmp_path: Path) -> None:
        Rig().save(tmp_path / "person.glb")
        with pytest.raises(RecipeError, match="no animation clips"):
            source(tmp_path)


def test_the_files_are_the_assets(folder: Path) -> None:
    assert [asset.name for asset in source(folder).assets] == ["devil.glb", "person.glb"]
    assert [asset.name for asset in source(folder, characters=["person"]).assets] == ["person.glb"]


@pytest.mark.slow
def test_every_animal_in_every_clip() -> None:
    """No clip of any animal tears another apart: edges keep their length but for the skin at joints."""
    require_animals()
    its = load_poses(PoseRecipe(distribution=ClipPoses()))
    assert isinstance(its, ClipSource)
    animals = load_characters("animals")
    body = load_body(RiggedBody(bone_scale=0.0))
    moments = [(each, clip, share) for each in animals for clip in each.clips for share in (0.1, 0.4, 0.7)]
    rotations = [
        its.at(each, name, clip.start + share * (clip.end - clip.start))
        for each, name, share in moments
        for clip in (each.clips[name],)
    ]
    poses = Poses(its.joints, its.parents, np.stack(rotations))
    assert len(moments) == 3 * 152
    for number, character in enumerate(animals):
        edges = edges_of(character.faces)
        vertices = body.vertices(np.array([number, *np.ones(len(body.parameter_names) - 1)]), poses)
        lengths, rest = (
            np.linalg.norm(v[..., edges[:, 0], :] - v[..., edges[:, 1], :], axis=-1)
            for v in (vertices, character.vertices)
        )
        assert np.isfinite(vertices).all() and np.median(np.abs(lengths / rest - 1)) < 0.02
        assert np.quantile(lengths / rest, 0.999) < 2.5, character.name


@pytest.mark.slow
def test_the_animals_by_recipe() -> None:
    require_animals()
    poses = draw_poses(PoseRecipe(distribution=ClipPoses(clips=("gallop*",), jitter=2.0)), range(20))
    assert poses.rotations.shape == (20, 34, 3) and np.abs(poses.rotations).max() < np.pi
    ranges = draw_poses(PoseRecipe(distribution=RangePoses(skeleton="animals", uniform=10.0)), range(20))
    assert ranges.joints == poses.joints and ranges.parents == poses.parents
