"""SMAL's animals: turned to our frame, equal to the reference implementation, drawn around families."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from datagen.bodies import load_body, require_joints
from datagen.bodies.smpl_family.model_search import FOLDER_VARIABLE, find_model
from datagen.bodies.smpl_family.smal import SmalModel
from datagen.common.errors import BodyError
from datagen.mesh.geometry import Mesh, check_mesh
from datagen.poses import Poses, draw_poses, load_poses
from datagen.poses.skeletons import SMAL_JOINTS, SMAL_PARENTS
from datagen.recipe import PoseRecipe, RangePoses, SmalBody
from tests.support.shapes.bodies import identity, standin_file
from tests.support.shapes.models import Arrays, random_model, reference, save_npz, save_pickle

RANGES = PoseRecipe(distribution=RangePoses(skeleton="smal", uniform=20))


def to_ours(native: np.ndarray) -> np.ndarray:
    """From SMAL's frame (+X to the head, +Y left, +Z up) to ours (+X left, +Y up, +Z to the front)."""
    x, y, z = np.moveaxis(native, -1, 0)
    return np.stack([y, z, x], axis=-1)


def to_native(ours: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(ours, -1, 0)
    return np.stack([z, x, y], axis=-1)


def arrays_of(joints: int) -> Arrays:
    return random_model(SMAL_PARENTS[:joints], betas=41, seed=2)


@pytest.fixture(scope="session")
def animal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The stand-in of SMAL."""
    return standin_file("smal", tmp_path_factory.mktemp("smal") / "smal.npz")


@pytest.mark.parametrize("joints", [33, 34, 35])
@pytest.mark.parametrize("save", [save_npz, save_pickle], ids=["npz", "pkl"])
def test_equals_the_reference_implementation_in_smals_own_frame(joints: int, save: object, tmp_path: Path) -> None:
    """smplx.lbs.lbs on the file as it is, its rotations and its vertices carried over as plain vectors."""
    arrays = arrays_of(joints)
    path = (save_npz if save is save_npz else save_pickle)(tmp_path / "smal.npz", arrays)
    body, poses = SmalModel(SmalBody(path=str(path))), draw_poses(RANGES, range(40))
    betas = identity(body)
    expected = to_ours(reference(arrays, betas, to_native(poses.rotations[:, :joints])))
    flat = to_ours(
        reference({**arrays, "posedirs": 0 * arrays["posedirs"]}, betas, to_native(poses.rotations[:, :joints]))
    )
    assert np.abs(expected - flat).max() > 0.02, "the pose blend shapes matter"
    assert np.abs(body.vertices(betas, poses) - expected).max() < 2e-6


def test_the_animal_stands_in_our_frame(animal: Path) -> None:
    """Y up, facing +Z, +X to its left: legs below, head in front, left ear to the left when it is moved."""
    body = SmalModel(SmalBody(path=str(animal)))
    rotations = np.zeros((4, 35, 3))
    for pose, joint in enumerate(("Head", "LFoot", "Tail1"), start=1):
        rotations[pose, SMAL_JOINTS.index(joint)] = 0.5
    rest, head, foot, tail = body.vertices(np.zeros(41), Poses(SMAL_JOINTS, SMAL_PARENTS, rotations))
    extent = np.ptp(rest, axis=0)
    assert extent[2] > extent[1] > extent[0] and 0.8 < extent[1] < 1.3

    def moved(posed: np.ndarray) -> np.ndarray:
        return rest[np.linalg.norm(posed - rest, axis=1) > 0.01]

    assert moved(head)[:, 2].min() > 0.4 and moved(head)[:, 1].mean() > 0.2
    assert moved(foot)[:, 0].min() > 0 and moved(foot)[:, 1].max() < -0.3 and moved(foot)[:, 2].mean() > 0
    assert moved(tail)[:, 2].max() < -0.3
    bowed = np.zeros((1, 35, 3))
    bowed[0, SMAL_JOINTS.index("Neck"), 0] = 0.8  # about +X: from up to front, so the head goes down
    lowered = body.vertices(np.zeros(41), Poses(SMAL_JOINTS, SMAL_PARENTS, bowed))[0]
    nose = rest[:, 2].argmax()
    assert lowered[nose, 1] < rest[nose, 1] - 0.15


def test_meshes_are_usable_and_identities_differ(animal: Path) -> None:
    body, poses = load_body(SmalBody(path=str(animal))), draw_poses(RANGES, range(3))
    drawn = np.stack([identity(body, n) for n in range(200)])
    assert drawn.shape[1] == 41 == len(body.parameter_names) and 0.95 < np.abs(drawn).max() <= 1
    assert np.abs(drawn.std(axis=0) - 1 / np.sqrt(3)).max() < 0.1
    for parameters in drawn[:3]:
        for vertices in body.vertices(parameters, poses):
            check_mesh(Mesh(vertices, body.faces(parameters)), name="animal")
    first, second = (body.vertices(parameters, poses[:1])[0] for parameters in drawn[:2])
    assert np.abs(first - second).max() > 0.05


def test_models_without_ears_take_poses_that_turn_them(animal: Path, tmp_path: Path) -> None:
    """SMAL_JOINTS for all: of a model with 33 joints the ears' move nothing."""
    body = SmalModel(SmalBody(path=str(save_npz(tmp_path / "smal.npz", arrays_of(33)))))
    require_joints(body, load_poses(RANGES), family="smal")
    rotations = np.zeros((2, 35, 3))
    rotations[1, 33:] = 1
    still, turned = body.vertices(np.zeros(41), Poses(SMAL_JOINTS, SMAL_PARENTS, rotations))
    assert np.array_equal(still, turned)


def families_file(path: Path, *, protocol: int = 2) -> Path:
    """As smal_CVPR2017_data.pkl: means and covariances of five families, and what nobody needs."""
    means = np.arange(5 * 41.0).reshape(5, 41) / 100
    covariances = [np.diag(np.full(41, float(family))) for family in range(5)]
    content = {"cluster_means": means, "cluster_cov": covariances, "toys_betas": np.zeros((41, 41))}
    path.write_bytes(pickle.dumps(content, protocol))
    return path


def test_identities_of_families_scatter_around_their_means(animal: Path, tmp_path: Path) -> None:
    """Identity modulo five is the family; deviations are uniform, in that family's standard deviations."""
    data = families_file(tmp_path / "smal_CVPR2017_data.pkl")
    body = SmalModel(SmalBody(path=str(animal), families=str(data), beta_range=0.5))
    drawn = np.stack([identity(body, n) for n in range(500)])
    means = np.arange(5 * 41.0).reshape(5, 41) / 100
    for family in range(5):
        deviation = drawn[family::5] - means[family]
        reach = 0.5 * np.sqrt(family)
        assert np.abs(deviation).max() <= reach + 1e-12 and np.abs(deviation).max() >= 0.99 * reach
    assert [asset.name for asset in body.assets] == ["SMAL", "SMAL families"]
    assert "non-commercial" in body.assets[1].licence and body.assets[0].licence.startswith("NOT the licensed")
    fewer = SmalModel(SmalBody(path=str(animal), families=str(data), betas=3))
    assert identity(fewer).shape == (3,)


def test_files_that_do_not_fit_are_refused(animal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    with pytest.raises(
        BodyError,
        match=r"https://smal\.is\.tue\.mpg\.de.*--recipe animals-paper.*dsffnet stand-in smal --out smal\.npz",
    ):
        SmalModel(SmalBody(path=str(tmp_path)))
    person = save_npz(tmp_path / "smal_person.npz", random_model(SMAL_PARENTS[:24]))
    with pytest.raises(BodyError, match="24 joints, but SMAL has 33 to 35"):
        SmalModel(SmalBody(path=str(person)))
    few = save_npz(tmp_path / "smal_few.npz", random_model(SMAL_PARENTS, betas=20))
    with pytest.raises(BodyError, match=r"--set data\.body\.betas=20"):
        SmalModel(SmalBody(path=str(few)))
    np.savez(tmp_path / "data.npz", cluster_means=np.zeros((5, 20)))
    with pytest.raises(BodyError, match=r"'cluster_means' has the shape \[5, 20\].*betas=20"):
        SmalModel(SmalBody(path=str(animal), families=str(tmp_path / "data.npz")))
    np.savez(tmp_path / "data.npz", cluster_means=np.zeros((5, 41)), cluster_cov=np.zeros((5, 41)))
    with pytest.raises(BodyError, match="'cluster_cov' has the shape"):
        SmalModel(SmalBody(path=str(animal), families=str(tmp_path / "data.npz")))
    with pytest.raises(BodyError, match=r"no 'cluster_means', so it is not SMAL's data file"):
        SmalModel(SmalBody(path=str(animal), families=str(animal)))


@pytest.mark.parametrize("name", ["smal_CVPR2017.pkl", "SMAL/smal_CVPR2017.npz", "my_smpl_00781_4_all.pkl", "smal.npz"])
def test_files_are_found_under_their_published_names(name: str, tmp_path: Path) -> None:
    for file in ("smal_CVPR2017_data.pkl", "SMPL_NEUTRAL.npz", "smal.txt", name):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    assert find_model(str(tmp_path), model="smal") == tmp_path / name


@pytest.mark.licensed
def test_licensed_files_stand_in_our_frame() -> None:
    """With SMAL in the folder that DSFFNET_BODY_MODELS names."""
    body = SmalModel(SmalBody())
    rest = body.vertices(np.zeros(41), Poses(SMAL_JOINTS, SMAL_PARENTS, np.zeros((1, 35, 3))))[0]
    assert np.ptp(rest, axis=0).argmax() == 2 and len(rest) == 3889
