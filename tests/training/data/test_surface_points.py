"""Points in the place of vertices lie on the surface, even by area, and are told what the rig says there."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from datagen.common.arrays import Floats
from datagen.generate import generate
from datagen.store import Dataset, open_dataset
from tests.support.recipes import LEG, MIXED_COUNTS, PARTS, mixed_dataset, tiny_training
from training.data.augmentation.augment import Augmentation
from training.data.batch import Batch
from training.data.rigs.bodies_at_rest import BodiesAtRest
from training.data.rigs.rig_table import RigTable
from training.data.row_random import Purpose, RowRandom
from training.data.surface_points import Triangles, points_of
from training.data.vertex_bank import open_bank
from training.networks.layers.rigid_parts import ancestors, moved_joints, skinned

TRIPLES = np.array([[0, 1, 1, 2], [1, 3, 2, 0], [2, 0, 1, 5]])
CPU = torch.device("cpu")
CORNERS = np.array([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [-1, 0, 0]])  # areas 3 and 1
FACES = np.array([[0, 1, 2], [0, 2, 3]])


PURPOSES = Purpose.AS_SOURCE_POINTS, Purpose.SOURCE_POINTS


def random(step: int, *, rows: int) -> RowRandom:
    return RowRandom.of_batch(0, step, first=0, rows=rows, device=CPU)


@pytest.fixture
def legs(dataset: str) -> Dataset:
    return open_dataset(dataset)


def surface_of_topology(legs: Dataset, identity: int, pose: int) -> torch.Tensor:
    """The cell of each vertex, as training has it in that pose."""
    rigs = RigTable(BodiesAtRest(legs, legs.identities("training")), LEG, device="cpu")
    triples = np.array([[identity, pose, identity, pose]])
    batch = rigs.posed(triples, open_bank(legs, legs.identities("training")).batch(triples))
    assert batch.surfaces is not None
    return batch.surfaces[0].cells[0]


def augmented(legs: Dataset, **changes: float) -> Batch:
    rigs = RigTable(BodiesAtRest(legs, legs.identities("training")), LEG, device="cpu")
    batch = open_bank(legs, legs.identities("training")).batch(TRIPLES)
    recipe = tiny_training(**{**PARTS, "augmentation": {"subset": 24, **changes}})
    return Augmentation(recipe, rigs)(TRIPLES, batch, step=2, first=0)


def test_points_are_even_by_area() -> None:
    triangles = Triangles(CORNERS, FACES, device=CPU)
    np.testing.assert_allclose(triangles.areas, [1 / 3, 1 / 4, 1 / 3, 1 / 12], atol=1e-6)
    numbers = random(0, rows=2).uniform(Purpose.SOURCE_POINTS, 10_000, 3)
    corners, shares = (each.flatten(0, 1) for each in triangles.drawn(numbers))
    assert (shares >= 0).all() and torch.allclose(shares.sum(dim=1), torch.ones(20_000))
    assert (shares.diff(dim=1) <= 0).all(), "the largest share first"
    at = (torch.from_numpy(CORNERS).float()[corners] * shares[..., None]).sum(dim=1).numpy()
    right = at[:, 0] > 0
    assert right.mean() == pytest.approx(0.75, abs=0.02)
    np.testing.assert_allclose(at[right].mean(axis=0), [1, 2 / 3, 0], atol=0.03)  # the centroid of its triangle
    np.testing.assert_allclose(at[~right].mean(axis=0), [-1 / 3, 2 / 3, 0], atol=0.03)


def test_values_are_mixed_by_shares_and_padding_stays() -> None:
    triangles = Triangles(CORNERS, FACES, device=CPU)
    points = points_of([triangles, triangles], (4, 3), 6, 1.0, random(1, rows=2), PURPOSES)
    assert points.drawn == (True, True) and not torch.equal(points.shares[0, :3], points.shares[1, :3])
    vertices = torch.randn((2, 6, 3), generator=torch.Generator().manual_seed(3))
    at_corners = torch.stack([vertices[mesh, points.corners[mesh].flatten()] for mesh in (0, 1)])
    for found in (points.of(vertices), points.mixed(at_corners)):
        for mesh, count in enumerate((4, 3)):
            mixed = torch.stack([vertices[mesh, own] for own in points.corners[mesh].T], dim=1)
            expected = (mixed * points.shares[mesh, :, :, None]).sum(dim=1)
            torch.testing.assert_close(found[mesh], expected)
            assert torch.equal(found[mesh, count:], vertices[mesh, count:])
            assert not torch.isclose(found[mesh, :count], vertices[mesh, :count]).all(dim=1).any()
    rows = torch.tensor([[5, 0, 2, 0], [1, 1, 4, 2]])
    some = points.at(rows).mixed(
        torch.stack([at_corners[mesh].view(6, 3, 3)[rows[mesh]] for mesh in (0, 1)]).flatten(1, 2)
    )
    assert torch.equal(some, torch.stack([points.of(vertices)[mesh, rows[mesh]] for mesh in (0, 1)]))
    untouched = points_of([triangles, triangles], (4, 3), 6, 0.0, random(1, rows=2), PURPOSES)
    assert torch.equal(untouched.of(vertices), vertices) and untouched.drawn == (False, False)


def test_of_several_surfaces_each_mesh_has_points_of_its_own(legs: Dataset) -> None:
    """Meshes of which some are drawn, in any order of topologies and counts, have what each would have alone."""
    square, line = Triangles(CORNERS, FACES, device=CPU), Triangles(CORNERS, FACES[:1], device=CPU)
    meshes, counts = [line, square, line, square, square, line], (3, 4, 5, 4, 3, 3)
    vertices = torch.randn((6, 5, 3), generator=torch.Generator().manual_seed(3))
    seen = set[tuple[bool, ...]]()
    for step in range(8):
        together = random(step, rows=6)
        points = points_of(meshes, counts, 5, 0.5, together, PURPOSES)
        seen.add(points.drawn)
        for row, (mesh, count) in enumerate(zip(meshes, counts, strict=True)):
            alone = RowRandom.of_batch(0, step, first=row, rows=1, device=CPU)
            its = points_of([mesh], [count], 5, 0.5, alone, PURPOSES)
            assert its.drawn == points.drawn[row : row + 1]
            assert torch.equal(its.corners[0], points.corners[row]) and torch.equal(its.shares[0], points.shares[row])
            assert torch.equal(its.of(vertices[row : row + 1])[0], points.of(vertices)[row])
            assert torch.equal(points.of(vertices)[row], vertices[row]) != points.drawn[row]
    assert len(seen) > 4


def test_rigs_say_of_points_what_they_say_around_them(legs: Dataset) -> None:
    batch, plain = augmented(legs, points=1.0), augmented(legs, points=0.0)
    assert batch.points and batch.posed and plain.posed and batch.surfaces and plain.surfaces
    for row, (source_identity, source_pose, target_identity, target_pose) in enumerate(TRIPLES.tolist()):
        for side, (meshes, rows, identity, pose) in enumerate(
            (
                (batch.source, batch.source_rows, source_identity, source_pose),
                (batch.target, batch.target_rows, target_identity, target_pose),
                (batch.truth, batch.target_rows, target_identity, source_pose),
            )
        ):
            assert rows is not None
            whole, points = torch.from_numpy(legs.vertices(identity, pose)), batch.points[min(side, 1)]
            low, high = whole.aminmax(dim=0)
            boxed = (whole - (low + high) / 2) / ((high - low).max() / 2)
            corners, shares = (each[row, rows[row]] for each in (points.corners, points.shares[..., None]))
            expected = (boxed[corners] * shares).sum(dim=1)
            torch.testing.assert_close(meshes[row], expected, rtol=0, atol=1e-3)
            if side < 2:
                rig = legs.rig(identity)
                assert rig is not None
                cells = surface_of_topology(legs, identity, pose)[points.corners[row, rows[row], 0]]
                assert torch.equal(batch.surfaces[side].cells[row], cells), "that of the nearest corner"
                weights = (torch.from_numpy(rig.weights).float()[corners] * shares).sum(dim=1)
                torch.testing.assert_close(batch.posed[side].weights[row], weights, rtol=0, atol=1e-5)
    for with_points, without in zip(batch.posed, plain.posed, strict=True):  # the same bodies in the same poses
        torch.testing.assert_close(with_points.rotations, without.rotations, rtol=0, atol=5e-4)
        torch.testing.assert_close(with_points.joints, without.joints, rtol=0, atol=5e-4)


def test_of_dense_meshes_vertices_are_drawn_by_the_area_around_them(
    legs: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    identities = legs.identities("training")
    rigs = RigTable(BodiesAtRest(legs, identities), LEG, device="cpu")
    whole = open_bank(legs, identities).batch(TRIPLES)
    assert rigs.areas(TRIPLES, whole) == (None, None), "of so few vertices a network samples all"
    monkeypatch.setattr("training.data.rigs.rig_table._DENSE", 10)
    recipe = tiny_training(**{**PARTS, "augmentation": {"subset": 8}})
    drawn = [Augmentation(recipe, rigs)(TRIPLES, whole, step=step, first=0) for step in range(400)]
    of_sources, of_targets = rigs.areas(TRIPLES, whole)
    assert of_sources is not None and of_targets is not None
    areas = of_sources[0]
    assert all(torch.equal(each, areas) for each in (*of_sources, *of_targets)), "they are of one topology"
    assert areas.sum() == pytest.approx(1, abs=1e-5)
    large = areas > areas.median()
    assert areas.max() > 1.2 * areas.min(), "else this would show nothing"
    for rows in ([each.source_rows for each in drawn], [each.target_rows for each in drawn]):
        numbers = torch.stack([own for own in rows if own is not None])
        assert all(len(set(own)) == 8 for own in numbers.flatten(0, 1).tolist())
        assert large[numbers].float().mean() == pytest.approx(float(areas[large].sum()), abs=0.03)


@pytest.mark.parametrize("most", [30, 29])
def test_areas_are_of_the_vertices_that_are_left_of_each_dense_mesh(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    """Of meshes of 32 and 30 vertices; all of the area lies around every third vertex, others for each topology."""
    kinds = list[Triangles]()

    class Striped(Triangles):
        def __init__(self, vertices: Floats, faces: NDArray[np.integer], *, device: torch.device) -> None:
            super().__init__(vertices, faces, device=device)
            self.areas = (torch.arange(len(vertices)) % 3 == len(kinds)).float()
            kinds.append(self)

    monkeypatch.setattr("training.data.rigs.rig_table.Triangles", Striped)
    mixed = open_dataset(generate(mixed_dataset(), str(tmp_path / "legs.zarr")).url)
    identities = mixed.identities("training")
    bank, rigs = open_bank(mixed, identities), RigTable(BodiesAtRest(mixed, identities), LEG, device="cpu")
    monkeypatch.setattr("training.data.rigs.rig_table._DENSE", most)
    assert [len(each.areas) for each in kinds] == [*MIXED_COUNTS], "as many topologies as there are kinds of legs"
    triples = np.array([[0, 1, 1, 2], [1, 3, 2, 0], [2, 0, 3, 5], [3, 2, 0, 1]])
    dense = np.array([[mixed.vertex_count(int(own)) > most for own in pair] for pair in triples[:, [0, 2]]])
    assert dense.any(axis=0).all() and dense.all() == (most < 30)

    def shares(**changes: float) -> np.ndarray:
        """Share of the drawn vertices around which the area lies, of each source and target [triple, 2]."""
        recipe = tiny_training(**{**PARTS, "augmentation": {"subset": 8, **changes}})
        found = []
        for step in range(40):
            batch = Augmentation(recipe, rigs)(triples, bank.batch(triples), step=step, first=0)
            rows = torch.stack([own for own in (batch.source_rows, batch.target_rows) if own is not None], dim=1)
            found.append(rows % 3 == torch.from_numpy(triples[:, [0, 2], None] % 3))
        return torch.stack(found).float().mean(dim=(0, 3)).numpy()

    plain, cut, points = shares(), shares(source_holes=0.8), shares(points=1.0)
    assert (plain[dense] == 1).all() and (plain[~dense] < 0.5).all()
    assert (cut[dense[:, 1], 1] == 1).all() and (cut[dense[:, 0], 0] > 0.75).all() and (cut[~dense] < 0.5).all()
    assert (points < 0.5).all()


def test_about_as_many_are_points_as_the_recipe_says(legs: Dataset) -> None:
    rigs = RigTable(BodiesAtRest(legs, legs.identities("training")), LEG, device="cpu")
    batch = open_bank(legs, legs.identities("training")).batch(TRIPLES)
    drawn = [rigs.of_points(TRIPLES, batch, 0.3, random(step, rows=3)) for step in range(60)]
    shares = [
        (each.points[side].shares[..., 0] < 1).any(dim=1).float() for each in drawn if each.points for side in (0, 1)
    ]
    assert torch.cat(shares).mean() == pytest.approx(0.3, abs=0.08)
    assert any((one != other).any() for one, other in zip(shares[::2], shares[1::2], strict=True)), "each mesh its own"
    assert not all(share.any() for share in shares), "of some batches none"
    said = [each.points[side].drawn for each in drawn if each.points for side in (0, 1)]
    assert [tuple(share.bool().tolist()) for share in shares] == said


def test_points_of_meshes_of_several_vertex_counts_are_turned_cut_and_thinned_like_vertices(
    tmp_path: Path,
) -> None:
    mixed = open_dataset(generate(mixed_dataset(), str(tmp_path / "legs.zarr")).url)
    bank, identities = open_bank(mixed, mixed.identities("training")), mixed.identities("training")
    changes = {"subset": 24, "points": 1.0, "turn": 25, "lean": 40, "source_holes": 0.8}
    recipe = tiny_training(**{**PARTS, "augmentation": changes})
    augment = Augmentation(recipe, RigTable(BodiesAtRest(mixed, identities), LEG, device="cpu"))
    triples = np.array([[0, 1, 1, 2], [1, 3, 2, 0], [2, 0, 3, 5], [4, 2, 0, 1]])
    plain = bank.batch(triples)
    assert plain.source_counts and plain.target_counts
    whole = augment(triples, plain, step=5, first=0)
    halves = [
        augment(triples[at], bank.batch(triples[at]), step=5, first=at.start) for at in (slice(0, 2), slice(2, 4))
    ]
    for name in ("source", "target", "truth", "source_rows", "target_rows"):
        parts = torch.cat([getattr(each, name) for each in halves])
        torch.testing.assert_close(parts, getattr(whole, name), rtol=0, atol=1e-6)
    assert whole.posed
    for posed, meshes in zip(whole.posed, (whole.source, whole.target), strict=True):
        joints = moved_joints(posed.rest_joints, posed.rotations, torch.tensor([0, 0]), ancestors([-1, 0]))
        bodies = skinned(posed.rest, posed.weights, posed.rotations, posed.rest_joints, joints)
        centred = [each - each.mean(dim=1, keepdim=True) for each in (bodies, meshes)]  # by mixed weights
        sizes = [each.square().sum((1, 2), keepdim=True).sqrt() for each in centred]
        torch.testing.assert_close(centred[0] * (sizes[1] / sizes[0]), centred[1], rtol=0, atol=0.05)


@pytest.mark.parametrize(("name", "value", "none"), [("points", 0.3, "0"), ("at_rest", True, "false")])
def test_what_needs_rigs_is_for_the_network_that_learns_from_them(name: str, value: object, none: str) -> None:
    with pytest.raises(ValueError, match=rf"augmentation\.{name} needs .* set augmentation\.{name} to {none}"):
        tiny_training(augmentation={name: value})
