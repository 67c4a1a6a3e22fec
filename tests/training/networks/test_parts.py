"""The parts network's own parts: joints, samples and their masses, misfit; what all networks keep is in the laws."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from datagen.mesh.geometry import bounding_box
from datagen.mesh.rig import part_transforms
from tests.support.shapes.samples import offsets_of
from tests.support.three_networks import lively, meshes
from training.networks import NETWORKS
from training.networks.layers import sampling
from training.networks.layers.rigid_parts import (
    ancestors,
    halved,
    matrices,
    mirrored,
    moved_joints,
    nearest_rotations,
    other_side,
    rotations_from_six,
    turned_about,
)
from training.networks.layers.sampling import MOST_SAMPLED, Sample, Surroundings, others, sample, taken
from training.networks.layers.surface import Surface
from training.networks.parts import Parts, Reading, boxed
from training.recipes.networks import PEOPLE

PARENTS = (-1, 0, 1, 0, 3)


def test_joints_go_where_the_datasets_rigs_put_them() -> None:
    random = np.random.default_rng(0)
    turns, joints = Rotation.random(10, random_state=1).as_matrix().reshape(2, 5, 3, 3), random.normal(size=(2, 5, 3))
    transforms = part_transforms(turns, joints, PARENTS)
    expected = (transforms[..., :3] @ joints[..., None])[..., 0] + transforms[..., 3]
    own = torch.tensor([max(parent, 0) for parent in PARENTS])
    found = moved_joints(torch.from_numpy(joints), torch.from_numpy(turns), own, ancestors(PARENTS))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_half_of_a_rotation_is_scipys() -> None:
    turns = Rotation.random(50, random_state=2)
    half = torch.from_numpy(Rotation.from_rotvec(turns.as_rotvec() / 2).as_matrix())
    torch.testing.assert_close(halved(torch.from_numpy(turns.as_matrix())), half, rtol=0, atol=1e-10)
    assert torch.equal(halved(torch.eye(3)), torch.eye(3))
    for degrees in (179.99, 180):
        whole = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        some = halved(torch.from_numpy(whole).float())
        torch.testing.assert_close(some @ some.mT, torch.eye(3), rtol=0, atol=1e-5)  # which one is left to rounding


def test_six_numbers_make_a_rotation() -> None:
    found = rotations_from_six(torch.randn(7, 6, dtype=torch.float64))
    torch.testing.assert_close(found @ found.mT, torch.eye(3, dtype=torch.float64).expand(7, 3, 3))
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(7, dtype=torch.float64))
    turns = torch.from_numpy(Rotation.random(4, random_state=2).as_matrix())
    torch.testing.assert_close(rotations_from_six(turns[..., :2].mT.flatten(1)), turns)
    assert torch.equal(matrices(torch.arange(9.0)), torch.arange(9.0).view(3, 3))


def sphere(count: int, *, upper: float, seed: int = 0) -> torch.Tensor:
    """Points [1, n, 3] of a ball with the surface of a person, a share of them in its upper half."""
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 1] = np.abs(points[:, 1]) * np.where(random.uniform(size=count) < upper, 1, -1)
    return 0.43 * torch.from_numpy(points).float()[None]


@pytest.mark.parametrize("count", [1500, 20_000])
def test_masses_are_of_the_surface_not_of_the_vertices(count: int) -> None:
    drawn = sample(sphere(count, upper=0.8))
    assert drawn.masses.shape[1] == min(count, MOST_SAMPLED)
    torch.testing.assert_close(drawn.masses.sum(1), torch.ones(1))
    upper = drawn.masses[0, drawn.vertices[0, :, 1] > 0].sum()
    assert abs(upper - 0.5) < 0.06  # of the vertices four in five


def test_a_sample_holds_every_region_once() -> None:
    vertices = sphere(20_000, upper=0.5)
    drawn = sample(vertices)
    kept = drawn.vertices[0][drawn.masses[0] > 0]
    assert torch.equal(drawn.vertices[0], vertices[0, drawn.rows[0]])
    assert len(torch.unique(kept, dim=0)) == len(kept) > 700
    assert torch.cdist(vertices[0, ::50], kept).min(1).values.max() < 0.11


def test_offsets_point_out_of_the_surface_however_dense_it_is() -> None:
    for count in (600, 20_000):
        vertices = sphere(count, upper=0.8)
        drawn = sample(vertices)
        outward = torch.nn.functional.cosine_similarity(offsets_of(vertices, drawn), vertices, dim=2)
        assert outward.mean() > (0.8 if count == 600 else 0.95)


@torch.no_grad()
@pytest.mark.parametrize("told", [False, True])
def test_vertices_beyond_the_sample_hear_what_they_would_of_all_of_it(
    monkeypatch: pytest.MonkeyPatch, told: bool
) -> None:
    network = lively("parts").double()
    assert isinstance(network, Parts)
    vertices = 2.3 * torch.cat([sphere(5000, upper=0.8), sphere(5000, upper=0.3, seed=1)]).double()
    surface = Surface(torch.zeros(2, 5000, dtype=torch.long), torch.ones(2, 1, 1, dtype=torch.bool)) if told else None
    drawn = sample(vertices, surface)
    found = network.read(drawn, vertices)
    assert all(around.near.shape[2] < MOST_SAMPLED for _, around in others(vertices, drawn)), (
        "some of it is out of reach"
    )
    monkeypatch.setattr(sampling, "_REACH", 9.0)
    assert all(around.near.shape[2] == MOST_SAMPLED for _, around in others(vertices, drawn))
    for one, other in zip(found, network.read(drawn, vertices), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-4)
    inside = taken(found.logits, drawn.rows)
    torch.testing.assert_close(inside, network.read(drawn).logits, rtol=0, atol=1e-9)


def test_parts_know_their_mirror_images_by_name() -> None:
    found = other_side(["right_hand", "head", "left_hand"])
    assert found is not None and found.tolist() == [2, 1, 0]
    assert other_side(["head", "left_hand"]) is None and other_side(["head", "neck"]) is None
    turn = turned_about(torch.tensor([[0.3, -0.2, 0.5]]))
    point, image = torch.tensor([1.0, 2, 3]), torch.tensor([-1.0, 2, 3])
    torch.testing.assert_close(mirrored(turn)[0] @ image, (turn[0] @ point) * torch.tensor([-1.0, 1, 1]))


@torch.no_grad()
def test_what_is_read_twice_is_the_same_of_a_mesh_and_of_its_mirror_image() -> None:
    network = lively("parts", joints=PEOPLE).eval()
    assert isinstance(network, Parts) and network.other_side is not None
    drawn, some = sample(meshes(300, seed=1)), torch.tensor([True, False])

    def image_of(rotations: torch.Tensor) -> torch.Tensor:
        return mirrored(rotations[:, network.other_side])

    once, twice = network._rotations(drawn, None), network._rotations(drawn, some)
    of_image = network._rotations(drawn.mirrored(), some)
    torch.testing.assert_close(image_of(of_image)[0], twice[0], rtol=0, atol=1e-5)
    assert (image_of(of_image)[1] - twice[1]).abs().max() > 0.1, "else this shows nothing"
    assert torch.equal(once[1], twice[1])
    torch.testing.assert_close(torch.linalg.det(twice), torch.ones(twice.shape[:2]))


@torch.no_grad()
def test_half_of_what_the_output_misses_is_corrected() -> None:
    network = lively("parts").eval()
    assert isinstance(network, Parts)
    network.out.weight *= 20  # so that what is read depends on the mesh
    source, target = meshes(300, seed=1), network.read_target(meshes(200, seed=2))

    def rotations_of(drawn: Sample) -> torch.Tensor:
        return network.read_again(drawn, network.read(drawn)).rotations

    wanted = rotations_of(sample(source))
    turns = wanted @ target.rotations.mT
    output = network.posed(target.vertices, target.weights, target.joints, turns)
    missing = wanted @ rotations_of(target.drawn.moved(taken(output, target.drawn.rows))).mT
    vectors = Rotation.from_matrix(missing.flatten(0, 1).numpy()).as_rotvec() / 2
    half = torch.from_numpy(Rotation.from_rotvec(vectors).as_matrix()).float().view_as(missing)
    expected = network.posed(target.vertices, target.weights, target.joints, half @ turns)
    torch.testing.assert_close(network.posed_target(source, target), expected, rtol=0, atol=1e-4)
    assert (expected - output).abs().max() > 0.05, "else this shows nothing"


class KnownRig(Parts):
    """Reads a body rightly as it is posed, all of it or its sample, and something else where it is at rest."""

    known: tuple[Reading, Reading]
    asked: tuple[torch.Tensor, ...] = ()

    def read(self, drawn: Sample, vertices: torch.Tensor | None = None) -> Reading:
        self.asked = (*self.asked, drawn.vertices)
        return self.known[vertices is None]


@pytest.mark.parametrize("count", [300, 2500])
def test_a_target_is_read_again_at_rest(count: int) -> None:
    random, names = np.random.default_rng(0), {"a": None, "b": "a", "c": "b", "d": "a", "e": "d"}
    network = KnownRig(joints=names, width=8, token_width=8, blocks=1).double().eval()
    turns, joints = Rotation.random(5, random_state=1), random.normal(size=(5, 3))
    rest, part = random.normal(size=(count, 3)), random.integers(5, size=count)
    transforms = part_transforms(turns.as_matrix(), joints, PARENTS)

    def carried(points: np.ndarray, parts: np.ndarray) -> np.ndarray:
        return np.einsum("nij,nj->ni", transforms[parts, :, :3], points) + transforms[parts, :, 3]

    def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
        return [torch.from_numpy(array)[None] for array in arrays]

    posed, places = bounding_box(carried(rest, part)), carried(joints, np.arange(5))
    vertices = torch.from_numpy(posed.normalise(carried(rest, part)))[None]
    rows = sample(vertices).rows
    at_rest = bounding_box(rest[rows[0].numpy()])
    missed, aside = random.normal(size=(5, 3)) * 0.1, Rotation.from_rotvec(random.normal(size=(5, 3)) * 0.3)
    own = np.eye(5)[part]
    logits = 40 * own
    network.known = (
        Reading(*tensors(logits, rest, turns.as_matrix(), posed.normalise(places))),
        Reading(
            *tensors((2 * own - logits)[rows[0]], rest[rows[0]], aside.as_matrix(), at_rest.normalise(joints) + missed)
        ),
    )
    target = network.read_target(vertices)
    torch.testing.assert_close(
        network.asked[1][0], torch.from_numpy(at_rest.normalise(rest)[rows[0]]), rtol=0, atol=1e-9
    )
    halfway = turns * Rotation.from_rotvec(aside.as_rotvec() / 2)
    np.testing.assert_allclose(target.rotations[0], halfway.as_matrix(), atol=1e-9)
    both = (turns.as_matrix() + turns.as_matrix()[[max(parent, 0) for parent in PARENTS]]) / 2
    moved = np.einsum("pij,pj->pi", both, missed) * at_rest.half / posed.half
    np.testing.assert_allclose(target.joints[0], posed.normalise(places) + moved / 2, atol=1e-9)
    means = own if count == 300 else logits  # those of a mesh that is not its own sample stay
    torch.testing.assert_close(target.weights[0], torch.from_numpy(means).softmax(1), rtol=0, atol=1e-12)


def test_a_graph_of_it_has_no_breaks() -> None:
    network = lively("parts", blocks=1).train()
    whole = torch.compile(network, fullgraph=True, backend="eager")
    for count in (300, 2500):
        given = {"source": meshes(count, seed=1), "target": meshes(count, seed=2)}
        torch.testing.assert_close(whole(**given), network(**given), rtol=0, atol=1e-5)


@torch.no_grad()
def test_meshes_of_a_batch_do_not_mix_where_they_are_more_than_their_samples() -> None:
    network = lively("parts").double().eval()
    large = torch.cat([sphere(2500, upper=0.8), 2.3 * sphere(2500, upper=0.3, seed=1)]).double()
    both = network(source=large, target=large.flip(2))
    for own in (slice(0, 1), slice(1, 2)):
        alone = network(source=large[own], target=large.flip(2)[own])
        torch.testing.assert_close(both[own], alone, rtol=0, atol=1e-11)


@torch.no_grad()
def test_export_takes_meshes_that_are_more_than_their_samples() -> None:
    network = lively("parts", blocks=1).eval()
    given = {"source": meshes(2500, seed=1), "target": meshes(2200, seed=2)}
    exported = torch.export.export(network, (), given).module()
    torch.testing.assert_close(exported(**given), network(**given), rtol=0, atol=1e-4)


def test_a_mesh_that_is_its_own_sample_is_passed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    network, vertices, passed = lively("parts"), meshes(MOST_SAMPLED, seed=3), []
    assert isinstance(network, Parts)
    once = network._passed

    def counted(around: Surroundings, *rest: Any) -> torch.Tensor:
        passed.append(around.vertices.shape[1])
        return once(around, *rest)

    monkeypatch.setattr(network, "_passed", counted)
    drawn = sample(vertices)
    assert torch.equal(taken(network.read(drawn, vertices).rest, drawn.rows), network.read(drawn).rest)
    assert passed == [MOST_SAMPLED] * 2


def test_parts_that_are_not_turned_leave_the_mesh_in_its_box() -> None:
    network, vertices = lively("parts"), meshes(40, seed=3)
    assert isinstance(network, Parts)
    still = torch.eye(3).expand(2, 4, 3, 3)
    weights = torch.rand(2, 40, 4).softmax(2)
    torch.testing.assert_close(
        network.posed(vertices, weights, torch.rand(2, 4, 3), still), boxed(vertices), rtol=0, atol=1e-5
    )


def test_a_vertex_that_is_no_number_spoils_its_pair_even_where_the_sample_leaves_it_out() -> None:
    network, source = lively("parts").eval(), meshes(3000, seed=5)
    source[0, 0] = torch.nan
    source[0, 1] = 0.001  # where the broken one is taken to be
    output = network(source=source, target=meshes(30, seed=6))
    assert output[0].isnan().all() and output[1].isfinite().all()
    with torch.no_grad():
        target = network.read_target(meshes(3000, seed=5))
        assert not (target.drawn.rows[0] == 0).any(), "else this shows nothing"
        posed = network.posed_target(source, target, alike=torch.tensor([True, True]))
    assert posed[0].isnan().all() and posed[1].isfinite().all()


def test_rotations_about_vectors_and_those_found_from_points_are_scipys() -> None:
    random = np.random.default_rng(0)
    vectors, points = random.normal(size=(6, 3)), random.normal(size=(6, 20, 3))
    expected = Rotation.from_rotvec(vectors).as_matrix()
    torch.testing.assert_close(turned_about(torch.from_numpy(vectors)), torch.from_numpy(expected))
    flat = points * (1, 1, 0)  # of points in a plane a reflection would do as well
    for some in (points, flat):
        moved = some @ expected.swapaxes(1, 2)
        spread = torch.from_numpy(np.einsum("bni,bnj->bij", moved, some))
        torch.testing.assert_close(nearest_rotations(spread), torch.from_numpy(expected))


@pytest.mark.parametrize("joints", [{"knee": "hip", "hip": None}, {}])
def test_joints_that_are_no_tree_are_refused(joints: dict[str, str | None]) -> None:
    with pytest.raises(ValueError, match=r"joints must name a tree|'hip' is not in"):
        NETWORKS["parts"](joints=joints)


def test_misfit_is_of_each_mesh_alone_and_does_not_see_the_vertices_order() -> None:
    network, vertices = lively("parts").eval(), meshes(60, seed=4)
    assert isinstance(network, Parts)
    found, roots = network.understood(vertices)
    assert found.shape == (2,) and roots.shape == (2, 3, 3) and (found >= 0).all()
    torch.testing.assert_close(roots @ roots.mT, torch.eye(3).expand(2, 3, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(network.understood(vertices[1:])[0], found[1:])
    torch.testing.assert_close(network.understood(vertices[:, torch.randperm(60)])[0], found, rtol=1e-4, atol=1e-6)


class Turning(Parts):
    """Reads every part of every mesh as turned by so many degrees."""

    degrees = 0.0

    def read(self, drawn: Sample, vertices: torch.Tensor | None = None) -> Reading:
        turn = torch.from_numpy(Rotation.from_euler("y", self.degrees, degrees=True).as_matrix()).float()
        found = super().read(drawn, vertices)
        return found._replace(rotations=turn.expand_as(found.rotations))


@pytest.mark.parametrize("degrees", [0.0, 10.0, 180.0])
def test_rest_error_is_what_is_read_of_a_mesh_at_rest(degrees: float) -> None:
    network = Turning(joints={"pelvis": None, "head": "pelvis"}, width=8, token_width=8, blocks=1).eval()
    drawn = sample(meshes(60, seed=4))
    reading = network.read(drawn)
    network.degrees = degrees
    torch.testing.assert_close(network.rest_error(reading, drawn), torch.full((2,), degrees), atol=0.05, rtol=0)


def test_rest_error_does_not_depend_on_how_the_mesh_is_turned_where_the_reading_follows() -> None:
    """What counts is rest, not the pose that leads there: a reading that is turned along says the same."""
    network, vertices = lively("parts").eval(), meshes(60, seed=4)
    assert isinstance(network, Parts)
    drawn = sample(vertices)
    reading = network.read(drawn)
    turn = torch.from_numpy(Rotation.from_euler("y", 90, degrees=True).as_matrix()).float()
    along = reading._replace(rotations=turn @ reading.rotations, joints=reading.joints @ turn.mT)
    lying = drawn.moved(drawn.vertices @ turn.mT)
    torch.testing.assert_close(network.rest_error(along, lying), network.rest_error(reading, drawn), atol=0.1, rtol=0)
