"""SMPL, SMPL-H and SMPL-X: equal to the reference implementation, and clear about files."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import smplx
import torch
from scipy.spatial.transform import Rotation
from smplx.utils import Struct
from threadpoolctl import threadpool_limits

from datagen.bodies import load_body
from datagen.bodies.smpl_family import blend_shapes
from datagen.bodies.smpl_family.blend_shapes import LayoutBody
from datagen.bodies.smpl_family.model_file import read_model
from datagen.bodies.smpl_family.model_search import find_model
from datagen.bodies.smpl_family.smpl import SmplModel, joint_names
from datagen.bodies.standins.smpl_format import standin, write_standin
from datagen.common.errors import BodyError
from datagen.mesh.rig import skinned
from datagen.poses import JOINTS, PARENTS, Poses, draw_poses
from datagen.recipe import AnnyBody, MixedBody, PoseRecipe, RangePoses, SmplBody
from tests.support.shapes.bodies import identity
from tests.support.shapes.models import arrays_of, random_model, reference, save_npz, tree

MODELS = ("smpl", "smplh", "smplx")
TOLERANCE = 2e-6  # metres
NPT = draw_poses(PoseRecipe(), range(40))


def random_poses(model: str, *, count: int = 40, degrees: float = 30) -> Poses:
    names = joint_names(model)
    rotations = np.radians(np.random.default_rng(1).uniform(-degrees, degrees, (count, len(names), 3)))
    return Poses(names, tree(model), rotations)


@pytest.fixture(scope="session")
def stand_ins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with stand-ins under the models' own file names."""
    folder = tmp_path_factory.mktemp("models")
    for model in MODELS:
        write_standin(model, folder / model / f"{model.upper()}_NEUTRAL.npz", topology="notoes_collapse5pc")
    return folder


@pytest.mark.parametrize(("degrees", "tolerance"), [(30, TOLERANCE), (90, 2 * TOLERANCE)])
@pytest.mark.parametrize("model", MODELS)
def test_equals_the_reference_implementation(model: str, degrees: float, tolerance: float, tmp_path: Path) -> None:
    """smplx.lbs.lbs in float64, with shape and pose blend shapes, for random rotations of every joint.

    What differs is the micrometre that skinning rounds joints to, which large turns along a chain add up.
    """
    path = save_npz(tmp_path / "model.npz", arrays_of(model))
    body, poses = SmplModel(SmplBody(model=model, path=str(path))), random_poses(model, degrees=degrees)
    betas = identity(body, 0, seed=3)
    expected = reference(arrays_of(model), betas, poses.rotations)
    still = reference({**arrays_of(model), "posedirs": arrays_of(model)["posedirs"] * 0}, betas, poses.rotations)
    assert np.abs(expected - still).max() > 0.02, "the pose blend shapes matter"
    assert np.abs(body.vertices(betas, poses) - expected).max() < tolerance


def test_equals_smplx_own_smpl_class(tmp_path: Path) -> None:
    """The SMPL class itself, on the stand-in with pose blend shapes added."""
    arrays = standin("smpl", topology="notoes_collapse3pc")
    arrays["posedirs"] = np.random.default_rng(0).normal(0, 0.004, arrays["posedirs"].shape)
    vertex_ids = dict.fromkeys([*FACE, *FEET, *TIPS], 0)
    theirs = smplx.SMPL("", data_struct=Struct(**arrays), vertex_ids=vertex_ids, dtype=torch.float64, batch_size=8)
    body = SmplModel(SmplBody(path=str(save_npz(tmp_path / "smpl.npz", arrays))))
    betas, poses = identity(body, 1), NPT[:8]
    rotations = torch.from_numpy(poses.rotations)
    posed = theirs(
        betas=torch.from_numpy(betas)[None].expand(8, -1),
        global_orient=rotations[:, :1].reshape(8, -1),
        body_pose=rotations[:, 1:].reshape(8, -1),
    )
    assert np.abs(body.vertices(betas, poses) - posed.vertices.detach().numpy()).max() < TOLERANCE


FACE = ("nose", "reye", "leye", "rear", "lear")
FEET = ("LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel")
TIPS = tuple(side + finger for side in "lr" for finger in ("thumb", "index", "middle", "ring", "pinky"))


def test_equals_smplx_own_smplx_class(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The SMPLX class reads the stand-in once it has the face landmarks and hand components that only SMPL-X uses."""
    arrays = standin("smplx", topology="notoes_collapse3pc")
    arrays["posedirs"] = np.random.default_rng(0).normal(0, 0.004, arrays["posedirs"].shape)
    extra: dict[str, Any] = {"lmk_faces_idx": np.zeros(51, int), "lmk_bary_coords": np.full((51, 3), 1 / 3)}
    extra |= {f"hands_{part}{side}": np.zeros((45, 45) if part == "components" else 45)
              for part in ("components", "mean") for side in "lr"}  # fmt: skip
    path = save_npz(tmp_path / "SMPLX_NEUTRAL.npz", {**arrays, **extra})
    monkeypatch.setitem(smplx.body_models.VERTEX_IDS, "smplx", dict.fromkeys([*FACE, *FEET, *TIPS], 0))
    theirs = smplx.SMPLX(str(path), ext="npz", use_pca=False, dtype=torch.float64, batch_size=8)
    body, poses = SmplModel(SmplBody(model="smplx", path=str(path))), random_poses("smplx", count=8)
    betas = identity(body, 1)
    parts = {"global_orient": 0, "body_pose": 1, "jaw_pose": 22, "leye_pose": 23, "reye_pose": 24,
             "left_hand_pose": 25, "right_hand_pose": 40, "end": 55}  # fmt: skip
    ends = [*parts.values()][1:]
    split = {
        name: torch.from_numpy(poses.rotations[:, first:end]).reshape(8, -1)
        for (name, first), end in zip(parts.items(), ends, strict=False)
    }
    posed = theirs(betas=torch.from_numpy(betas)[None].expand(8, -1), **split)
    assert np.abs(body.vertices(betas, poses) - posed.vertices.detach().numpy()).max() < TOLERANCE


@pytest.mark.parametrize("model", MODELS)
def test_joint_names_and_trees_agree(model: str) -> None:
    """Our names with the package's, whose SMPL-H and SMPL-X trees the stand-ins have."""
    names, arrays = joint_names(model), standin(model, topology="notoes_collapse3pc")
    assert len(names) == len(set(names)) == {"smpl": 24, "smplh": 52, "smplx": 55}[model]
    assert names[:22] == JOINTS[:22] and tuple(arrays["kintree_table"][0]) == tree(model)


def test_bytes_do_not_depend_on_batches_threads_or_the_order_of_sums(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every sum is exact: any order of the pose blend shapes' and the shapes' terms gives the same bits."""
    file = read_model(save_npz(tmp_path / "m.npz", arrays_of("smpl")))
    body, world = LayoutBody(file, betas=10, reach=4), NPT.on(JOINTS, PARENTS)
    betas = np.random.default_rng(0).uniform(-4, 4, 10)
    with threadpool_limits(2):
        whole = body.vertices(betas, world)
    with threadpool_limits(1):
        assert np.array_equal(whole[17], body.vertices(betas, world[17:18])[0])
    monkeypatch.setattr(blend_shapes, "VERTICES_AT_ONCE", 7 * len(file.template))
    assert np.array_equal(whole, body.vertices(betas, world)) and len(world) % 7
    shuffled = np.random.default_rng(1).permutation(10)
    other = LayoutBody(replace(file, shapedirs=file.shapedirs[..., shuffled]), betas=10, reach=4)
    assert np.array_equal(whole, other.vertices(betas[shuffled], world))
    features, terms = np.random.default_rng(2).integers(-(2**20), 2**20, 207) / 2**20, body._posedirs
    assert terms is not None
    products = features[:, None] * terms
    forward, backward = products[0] * 0, products[0] * 0
    for row in range(207):
        forward, backward = forward + products[row], backward + products[206 - row]
    assert np.array_equal(forward, backward) and np.array_equal(forward, features @ terms)


def test_pose_blend_shapes_see_rotations_relative_to_the_parent(tmp_path: Path) -> None:
    """Turning the whole body changes nothing but its direction."""
    body = SmplModel(SmplBody(path=str(save_npz(tmp_path / "m.npz", arrays_of("smpl")))))
    betas = identity(body)
    bent = NPT.rotations[:2].copy()
    bent[0, 0], bent[1] = 0, bent[0]
    bent[1, 0] = [0.0, np.pi / 2, 0.0]
    straight, around = body.vertices(betas, Poses(JOINTS, PARENTS, bent)).astype(float)
    quarter = Rotation.from_rotvec(bent[1, 0]).as_matrix()
    difference = around - straight @ quarter.T
    assert np.ptp(difference, axis=0).max() < 4e-6, "up to where the pelvis lies"


def test_a_rig_leaves_out_the_pose_blend_shapes_and_nothing_else(tmp_path: Path) -> None:
    """Added to the vertices at rest they give the body's; without them the rig is off by what they displace."""
    path = save_npz(tmp_path / "m.npz", arrays_of("smpl"))
    body, layout = SmplModel(SmplBody(path=str(path))), LayoutBody(read_model(path), betas=10, reach=4)
    betas, world = identity(body), NPT.on(JOINTS, PARENTS)
    rig, rest, displaced = body.rig(betas, JOINTS), layout.rest(betas).vertices, layout.correctives(world)
    posed, transforms = body.vertices(betas, NPT), rig.transforms(NPT.world())
    with_them = [
        skinned(rest + its, rig.weights, its_transforms[None])[0]
        for its, its_transforms in zip(displaced, transforms, strict=True)
    ]
    assert np.abs(with_them - posed).max() < 1e-5
    lacking = np.linalg.norm(skinned(rest, rig.weights, transforms) - posed, axis=-1)
    assert 0.01 < lacking.max() <= np.linalg.norm(displaced, axis=-1).max() + 1e-5


@pytest.mark.parametrize(("model", "kept"), [("smpl", 24), ("smplh", 30), ("smplx", 30)])
def test_joints_that_the_poses_do_not_turn_are_folded(model: str, kept: int, stand_ins: Path) -> None:
    """Of SMPL-H's and SMPL-X' fingers the four knuckles of each hand remain, which obey its hand joint."""
    rig = SmplModel(SmplBody(model=model, path=str(stand_ins))).rig(np.zeros(10), JOINTS)
    assert len(rig.names) == kept and not {"left_index2", "right_thumb1", "jaw"} & set(rig.names)
    turning = [JOINTS[driver] for driver in rig.drivers]
    assert set(turning) == set(JOINTS) and turning.count("left_hand") == (1 if model == "smpl" else 4)


def test_identities_are_npts(stand_ins: Path) -> None:
    """Uniform within +-4, ten of them, each a function of seed and number."""
    body = load_body(SmplBody(path=str(stand_ins)))
    drawn = np.stack([identity(body, n) for n in range(400)])
    assert body.parameter_names == tuple(f"beta{n}" for n in range(10))
    assert drawn.min() < -3.9 and drawn.max() > 3.9 and np.abs(drawn).max() <= 4
    assert np.abs(drawn.std(axis=0) - 8 / np.sqrt(12)).max() < 0.25
    assert np.array_equal(drawn[7], identity(body, 7))


@pytest.mark.parametrize("model", MODELS[1:])
def test_smpls_hand_joints_bend_the_four_finger_roots(model: str, stand_ins: Path) -> None:
    body = SmplModel(SmplBody(model=model, path=str(stand_ins)))
    rotations = np.zeros((2, 24, 3))
    rotations[1, JOINTS.index("left_hand"), 2] = -0.8
    bent = body.vertices(np.zeros(10), Poses(JOINTS, PARENTS, rotations))
    own = Poses(joint_names(model), tree(model), np.zeros((1, len(joint_names(model)), 3)))
    for finger in ("index1", "middle1", "ring1", "pinky1"):
        own.rotations[0, own.joints.index(f"left_{finger}"), 2] = -0.8
    assert np.array_equal(bent[1], body.vertices(np.zeros(10), own)[0])
    moved = np.linalg.norm(bent[1] - bent[0], axis=1) > 2e-3  # Anny has one vertex of the other hand at 0.0002
    assert 10 < moved.sum() < 200 and bent[0][moved, 0].min() > 0.6, "the left hand's fingers and nothing else"


@pytest.mark.parametrize("model", MODELS)
def test_a_pose_draws_alike_on_anny_and_on_the_stand_ins(model: str, stand_ins: Path) -> None:
    """Vertex by vertex: the stand-in, fitted to an Anny body in the T-pose, stays that body in every NPT pose.

    They differ by what ten shape parameters cannot say in the T-pose, and by where the fitted joints lie.
    """
    anny = load_body(AnnyBody(topology="notoes_collapse5pc"))
    adult = np.array([{"age": 0.7, "height": 0.5}.get(name, 0.5) for name in anny.parameter_names])
    rest = anny.vertices(adult, Poses(JOINTS, PARENTS, np.zeros((1, 24, 3))))[0]
    body = SmplModel(SmplBody(model=model, path=str(stand_ins)))
    arrays = read_model(find_model(str(stand_ins), model=model))
    directions = arrays.shapedirs[..., :10].reshape(-1, 10)
    betas = np.linalg.lstsq(directions, (rest - arrays.template).ravel(), rcond=None)[0]
    apart = np.linalg.norm(anny.vertices(adult, NPT) - body.vertices(betas, NPT), axis=-1)
    between_poses = np.linalg.norm(np.diff(anny.vertices(adult, NPT), axis=0), axis=-1).mean()
    assert apart.mean() < 0.0025 and np.quantile(apart, 0.99) < 0.01 and apart.max() < 0.025
    assert apart.mean() < 0.01 * between_poses


def test_people_of_anny_and_smpl_in_one_dataset(stand_ins: Path) -> None:
    recipe = MixedBody(bodies=(AnnyBody(topology="notoes_collapse3pc"), SmplBody(path=str(stand_ins))))
    body = load_body(recipe)
    assert set(JOINTS) <= set(body.joints) and len(body.assets) == 2
    counts = []
    for number in range(4):
        parameters = identity(body, number)
        vertices, faces = body.vertices(parameters, NPT[:3]), body.faces(parameters)
        assert np.isfinite(vertices).all() and faces.max() == vertices.shape[1] - 1
        counts.append(vertices.shape[1])
    assert counts == [369, 615, 369, 615]


def test_assets_name_the_licence_and_the_hash(stand_ins: Path, tmp_path: Path) -> None:
    import hashlib

    path = save_npz(tmp_path / "mine.npz", arrays_of("smpl"))
    (licensed,) = SmplModel(SmplBody(path=str(path), gender="female")).assets
    assert licensed.name == "SMPL female" and "non-commercial" in licensed.licence
    assert licensed.version == "sha256:" + hashlib.sha256(path.read_bytes()).hexdigest()
    (free,) = SmplModel(SmplBody(path=str(stand_ins))).assets
    assert free.licence.startswith("NOT the licensed model") and "CC0" in free.licence


def test_smplx_shape_parameters_end_where_expressions_begin(tmp_path: Path) -> None:
    path = save_npz(tmp_path / "x.npz", random_model(tree("smplx"), betas=400, vertices=20))
    assert len(SmplModel(SmplBody(model="smplx", path=str(path), betas=300)).parameter_names) == 300
    with pytest.raises(BodyError, match=r"300 shape parameters, but data\.body\.betas asks for 301"):
        SmplModel(SmplBody(model="smplx", path=str(path), betas=301))


def test_poses_may_name_only_what_the_body_has(stand_ins: Path) -> None:
    body = SmplModel(SmplBody(model="smplh", path=str(stand_ins)))
    assert set(JOINTS) < set(body.joints) and "left_thumb3" in body.joints
    poses = draw_poses(PoseRecipe(distribution=RangePoses(uniform=5)), range(2))
    assert body.vertices(np.zeros(10), poses).dtype == np.float32


@pytest.mark.licensed
@pytest.mark.parametrize("model", MODELS)
def test_licensed_files_equal_the_reference(model: str) -> None:
    """With files of the user's in the folder that DSFFNET_BODY_MODELS names."""
    path = find_model(None, model=model)
    body, file = SmplModel(SmplBody(model=model)), read_model(path)
    betas, poses = identity(body), random_poses(model, count=4)
    arrays = {"v_template": file.template, "shapedirs": file.shapedirs, "posedirs": file.posedirs,
              "J_regressor": file.regressor, "weights": file.weights,
              "kintree_table": np.array([file.parents, range(len(file.parents))])}  # fmt: skip
    assert np.abs(body.vertices(betas, poses) - reference(arrays, betas, poses.rotations)).max() < TOLERANCE
