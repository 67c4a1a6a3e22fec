"""Licence-free stand-ins: files like the licensed models', of bodies that look like bodies."""

from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from datagen.bodies.anny.model import AnnyModel
from datagen.bodies.smpl_family.model_file import KEYS, read_model
from datagen.bodies.smpl_family.smpl import joint_names
from datagen.bodies.standins.fit import fit_regressor, principal_shapes
from datagen.bodies.standins.quadruped import quadruped
from datagen.bodies.standins.smpl_format import _ADULTS, _by_joint, _pivots, standin, write_standin
from datagen.common.errors import BodyError, StorageError
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import edges_of
from datagen.poses.skeletons import SMAL_JOINTS, SMAL_PARENTS
from datagen.recipe import AnnyBody
from tests.support.shapes.bodies import COARSE, identity, standin_file

KINDS = {"smpl": (24, 10), "smplh": (52, 10), "smplx": (55, 20), "smal": (35, 41)}


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("stand-ins")
    return {kind: standin_file(kind, folder / f"{kind}.npz") for kind in KINDS}


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    corners = vertices[faces]
    return float(np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)


@pytest.mark.parametrize("kind", KINDS)
def test_the_layout_is_the_models_and_the_note_says_that_it_is_not_the_model(kind: str, files: dict[str, Path]) -> None:
    joints, betas = KINDS[kind]
    model = read_model(files[kind])
    assert len(model.parents) == joints and model.shapedirs.shape[2] == betas
    assert np.abs(model.weights.sum(axis=1) - 1).max() < 1e-12 and model.weights.min() >= 0
    assert np.abs(model.regressor.sum(axis=1) - 1).max() < 1e-12 and model.regressor.min() >= 0
    assert (model.regressor > 0).sum(axis=1).max() <= 40, "sparse"
    assert not model.posedirs.any() and "NOT the licensed model" in model.note and "CC0" in model.note
    with np.load(files[kind], allow_pickle=False) as content:
        assert set(content) == {*KEYS, "note"}


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_arguments_give_the_same_bytes(kind: str, files: dict[str, Path], tmp_path: Path) -> None:
    """Whatever the number of threads of the linear algebra."""
    quadruped.cache_clear()
    with threadpool_limits(2):
        again = write_standin(kind, tmp_path / "again.npz", topology=COARSE)
    assert again.read_bytes() == files[kind].read_bytes()


@pytest.mark.parametrize("kind", ["smpl", "smplh"])
def test_regressed_joints_lie_where_annys_do(kind: str, files: dict[str, Path]) -> None:
    """For people that the regressor has not seen, every joint: two millimetres off, in the chest up to sixteen."""
    body = AnnyModel(AnnyBody(topology=COARSE, rig="mixamo", phenotypes=_ADULTS))
    regressor, names = read_model(files[kind]).regressor, joint_names(kind)
    carried = _by_joint(body.bones, names)
    apart = []
    for number in range(500, 520):
        vertices, heads = body.t_pose(identity(body, number))
        truth = np.stack([heads[_pivots(name, carried)].mean(axis=0) for name in names])
        apart.append(np.linalg.norm(regressor @ vertices - truth, axis=1))
    assert np.mean(apart) < 0.0025 and np.max(apart) < 0.018


def test_new_people_of_anny_are_within_the_shape_space(files: dict[str, Path]) -> None:
    model = read_model(files["smpl"])
    body = AnnyModel(AnnyBody(topology=COARSE, rig="mixamo", phenotypes=_ADULTS))
    for number in range(500, 510):
        offset = (body.t_pose(identity(body, number))[0] - model.template).ravel()
        directions = model.shapedirs.reshape(-1, 10)
        betas, *_ = np.linalg.lstsq(directions, offset, rcond=None)
        left = np.linalg.norm((offset - directions @ betas).reshape(-1, 3), axis=1)
        assert left.mean() < 0.004 and np.abs(betas).max() < 4


@pytest.mark.parametrize(("reach", "shortest", "tallest"), [(2, 1.65, 2.0), (4, 1.5, 2.15)])
def test_shapes_stay_human(reach: float, shortest: float, tallest: float, files: dict[str, Path]) -> None:
    """Betas of +-2 are plausible and those of +-4, as NPT draws them, still of human size and not inside out."""
    model, random = read_model(files["smpl"]), np.random.default_rng(0)
    bodies = model.template + np.einsum("vcb,nb->nvc", model.shapedirs, random.uniform(-reach, reach, (200, 10)))
    statures = np.ptp(bodies[:, :, 1], axis=1)
    assert statures.min() > shortest and statures.max() < tallest
    volumes = [volume(body, model.faces) for body in bodies]
    assert min(volumes) > 0.025 and max(volumes) < 0.13, "cubic metres"


def test_smplx_jaw_eyes_and_expressions_move_nothing(files: dict[str, Path]) -> None:
    model, names = read_model(files["smplx"]), joint_names("smplx")
    face = [names.index(name) for name in ("jaw", "left_eye_smplhf", "right_eye_smplhf")]
    assert not model.weights[:, face].any() and not model.shapedirs[..., 10:].any()
    assert model.weights[:, names.index("left_index2")].any() and model.shapedirs[..., :10].any()


def test_the_animal_is_one_closed_symmetric_surface() -> None:
    animal = quadruped()
    sides = np.concatenate([animal.faces[:, [0, 1]], animal.faces[:, [1, 2]], animal.faces[:, [2, 0]]])
    edges = edges_of(animal.faces)
    assert len(sides) == 2 * len(edges) and len(np.unique(sides, axis=0)) == len(sides), "closed, consistently oriented"
    assert len(animal.vertices) - len(edges) + len(animal.faces) == 2, "one piece without holes"
    assert 0.05 < volume(animal.vertices, animal.faces) < 0.15 and 3000 < len(animal.vertices) < 5000
    mirrored = animal.vertices * [1, -1, 1]
    nearest = [np.linalg.norm(animal.vertices - point, axis=1).min() for point in mirrored[::50]]
    assert max(nearest) < 1e-4


def test_the_animal_has_smals_skeleton_and_each_joint_its_skin() -> None:
    animal = quadruped()
    assert animal.parents == SMAL_PARENTS and len(animal.joints) == len(SMAL_JOINTS)
    assert (animal.weights.max(axis=0) > 0.4).all(), "every bone rules some of the surface"
    left = animal.vertices[:, 1] > 0.02
    right_legs = [n for n, name in enumerate(SMAL_JOINTS) if name.startswith("R") and name[1:2].isupper() and n > 7]
    assert len(right_legs) >= 8 and animal.weights[left][:, right_legs].max() < 0.1
    vertices, joints = animal.drawn(generator(0, Stream.IDENTITY, 3))
    assert np.abs(vertices - animal.vertices).max() > 0.02
    assert np.abs(joints[:, 1].sum()) < 1e-9, "left and right alike"
    assert np.array_equal(vertices, animal.drawn(generator(0, Stream.IDENTITY, 3))[0])


def test_animals_of_the_shape_space_keep_their_volume(files: dict[str, Path]) -> None:
    model, random = read_model(files["smal"]), np.random.default_rng(0)
    bodies = model.template + np.einsum("vcb,nb->nvc", model.shapedirs, random.uniform(-2, 2, (50, 41)))
    assert all(0.02 < volume(body, model.faces) < 0.2 for body in bodies)


def test_principal_shapes_are_those_of_a_known_mixture() -> None:
    random = np.random.default_rng(0)
    directions = np.linalg.qr(random.normal(size=(60, 2)))[0].T * [[0.3], [0.1]]
    factors = random.normal(size=(4000, 2))
    bodies = (1 + factors @ directions).reshape(-1, 20, 3)
    mean, shapes = principal_shapes(bodies, 2)
    assert np.abs(mean - 1).max() < 0.01
    for found, true in zip(shapes.reshape(60, 2).T, directions, strict=True):
        assert abs(found @ true) / (true @ true) == pytest.approx(1, abs=0.05)
        assert found[np.abs(found).argmax()] > 0


def test_regressors_are_convex_and_exact_where_they_can_be() -> None:
    random = np.random.default_rng(0)
    bodies = random.normal(size=(30, 40, 3)) * 0.02 + random.normal(size=(40, 3))
    joints = bodies[:, [3, 7, 11]].mean(axis=1)[:, None]
    regressor = fit_regressor(bodies, joints)
    assert np.abs(regressor[0, [3, 7, 11]] - 1 / 3).max() < 1e-6 and regressor.sum() == 1


def test_mistakes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BodyError, match="no stand-in of 'flame'; there are smpl, smplh, smplx, smal"):
        standin("flame")  # type: ignore[arg-type]
    with pytest.raises(BodyError, match=r"try .*smpl\.npz"):
        write_standin("smpl", tmp_path / "smpl.pkl")
    (tmp_path / "file").touch()
    with pytest.raises(StorageError):
        write_standin("smpl", tmp_path / "file" / "smpl.npz", topology=COARSE)
