"""The contract that every body family keeps, and what is particular to each."""

import numpy as np
import pytest

from datagen.bodies import BodyModel, load_body
from datagen.mesh import Mesh, bounding_box, check_mesh
from datagen.poses import JOINTS, draw_poses
from datagen.random import Stream, generator
from datagen.recipe import AnnyBody, LegBody, PhenotypeRanges, PoseRecipe

RECIPES = {"anny": AnnyBody(topology="notoes_collapse3pc"), "leg": LegBody()}
POSES = draw_poses(PoseRecipe(), range(40))


@pytest.fixture(params=sorted(RECIPES), scope="module")
def body(request: pytest.FixtureRequest) -> BodyModel:
    return load_body(RECIPES[request.param])


def identity(body: BodyModel, number: int) -> np.ndarray:
    return body.draw_identity(generator(0, Stream.IDENTITY, number))


def test_parameters_are_named_and_drawn_from_their_seed(body: BodyModel) -> None:
    first = identity(body, 0)
    assert first.shape == (len(body.parameter_names),) and np.isfinite(first).all()
    assert np.array_equal(first, identity(body, 0)) and not np.array_equal(first, identity(body, 1))


def test_every_mesh_is_usable_and_closed_enough(body: BodyModel) -> None:
    parameters = identity(body, 3)
    faces = body.faces(parameters)
    for vertices in body.vertices(parameters, POSES[:5]):
        check_mesh(Mesh(vertices, faces), name="body")
    assert np.array_equal(np.unique(faces), np.arange(faces.max() + 1)), "every vertex belongs to a face"


def test_outward_faces(body: BodyModel) -> None:
    """Signed volume is positive: faces are counter-clockwise seen from outside."""
    parameters = identity(body, 0)
    corners = body.vertices(parameters, POSES[:1])[0][body.faces(parameters)].astype(float)
    assert np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0


def test_poses_and_identities_change_the_mesh(body: BodyModel) -> None:
    here, there = (body.vertices(identity(body, number), POSES[:2]) for number in (0, 1))
    assert np.abs(here[0] - here[1]).max() > 0.05 and np.abs(here - there).max() > 0.01


def test_a_batch_gives_what_single_poses_give_to_the_bit(body: BodyModel) -> None:
    parameters = identity(body, 2)
    batch = body.vertices(parameters, POSES)
    assert batch.dtype == np.float32
    for row in (0, 17, 39):
        assert np.array_equal(batch[row], body.vertices(parameters, POSES[row : row + 1])[0])


def test_metres_and_y_up(body: BodyModel) -> None:
    vertices = body.vertices(identity(body, 0), np.zeros((1, 24, 3)))[0]
    height = np.ptp(vertices[:, 1])
    assert 0.5 < height < 2.5 and height == pytest.approx(2 * bounding_box(vertices).half, rel=0.3)


def test_bending_the_left_knee_moves_the_left_foot_backwards(body: BodyModel) -> None:
    """SMPL's convention: +X is the body's left, +Z its front; a positive turn about x at the knee swings back."""
    poses = np.zeros((2, 24, 3))
    poses[1, JOINTS.index("left_knee"), 0] = np.radians(90)
    straight, bent = body.vertices(identity(body, 0), poses)
    foot = straight[:, 1] < straight[:, 1].min() + 0.1 * np.ptp(straight[:, 1])
    left = foot & (straight[:, 0] >= straight[foot, 0].mean())
    moved = (bent - straight)[left].mean(axis=0)
    assert moved[2] < -0.2 and moved[1] > 0.05


class TestAnny:
    """Anny in SMPL's convention."""

    @pytest.fixture
    def anny(self) -> BodyModel:
        return load_body(RECIPES["anny"])

    def test_zero_pose_is_a_t_pose(self, anny: BodyModel) -> None:
        vertices = anny.vertices(identity(anny, 0), np.zeros((1, 24, 3)))[0]
        for side in (1, -1):
            arm = vertices[vertices[:, 0] * side > 0.55 * np.abs(vertices[:, 0]).max()]
            assert np.ptp(arm[:, 1]) < 0.15, "the arm is level"
            assert np.ptp(arm[:, 2]) < 0.25, "and points sideways"

    def test_skinning_equals_annys_own(self, anny: BodyModel) -> None:
        """Our linear blend skinning against Anny's forward pass, for random poses of all bones."""
        import torch

        model = anny._model  # type: ignore[attr-defined]
        parameters = identity(anny, 5)
        turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        deltas = np.tile(np.eye(4), (len(POSES), len(anny._bones), 1, 1))  # type: ignore[attr-defined]
        deltas[:, :, :3, :3] = turn.T @ anny._rotations(POSES) @ turn  # type: ignore[attr-defined]
        names = zip(anny.parameter_names, parameters, strict=True)
        theirs = model(
            pose_parameters=torch.from_numpy(deltas),
            phenotype_kwargs={name: torch.tensor([value], dtype=torch.float64) for name, value in names},
        )["vertices"].numpy()
        ours = anny.vertices(parameters, POSES)
        difference = theirs @ turn.T - ours
        difference -= difference.mean(axis=1, keepdims=True)  # Anny puts the root at the origin, we leave it in place
        assert np.abs(difference).max() < 1e-6

    def test_phenotype_ranges_are_obeyed(self) -> None:
        ranges = PhenotypeRanges(age=(0.7, 0.8), weight=(0.1, 0.1))
        anny = load_body(AnnyBody(topology="notoes_collapse3pc", phenotypes=ranges))
        drawn = np.stack([identity(anny, number) for number in range(50)])
        columns = dict(zip(anny.parameter_names, drawn.T, strict=True))
        assert columns["age"].min() >= 0.7 and columns["age"].max() <= 0.8 and np.ptp(columns["age"]) > 0.05
        assert np.allclose(columns["weight"], 0.1) and np.ptp(columns["gender"]) > 0.5

    def test_a_killed_cache_build_is_not_trusted(self, tmp_path, monkeypatch) -> None:
        """What a build left that never took its mark away is removed, older files stay."""
        import os

        from datagen.bodies.anny import _forget_since

        old, new, mark = tmp_path / "old.safetensors", tmp_path / "v1" / "new.safetensors", tmp_path / "mark"
        new.parent.mkdir()
        for path, age in ((old, 100), (mark, 50), (new, 10)):
            path.write_bytes(b"x")
            stamp = path.stat().st_mtime - age
            os.utime(path, (stamp, stamp))
        _forget_since(tmp_path, mark)
        assert old.exists() and not new.exists()


@pytest.mark.parametrize("bad", [(-0.1, 0.5), (0.6, 0.5), (0.5, 1.2)])
def test_impossible_phenotype_ranges_are_refused(bad: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="age"):
        PhenotypeRanges(age=bad)
