"""Batches: the right meshes, edges of one topology or many, and augmentation that depends on nothing but its place."""

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from datagen.common.errors import DatasetError
from datagen.generate import generate
from datagen.mesh.geometry import bounding_box, edges_of
from datagen.store import Dataset, open_dataset
from tests.support.recipes import LEG, MIXED_COUNTS, PARTS, mixed_dataset, tiny_training
from training.data.augmentation.augment import Augmentation
from training.data.augmentation.shuffle import Shuffle
from training.data.batch import Batch, EdgeTable, PackedEdges, read_batch
from training.data.rigs.bodies_at_rest import BodiesAtRest
from training.data.rigs.rig_table import RigTable
from training.data.triples import TripleOrder
from training.data.vertex_bank import open_bank
from training.networks.dsffnet import DSFFNet
from training.networks.layers.surface import surface_of
from training.networks.padded_batches import MixedCounts
from training.objectives.losses import INCIDENCES, incidence_of, make_incidence

TRIPLES = np.array([[0, 1, 1, 2], [1, 3, 2, 0], [2, 0, 3, 5], [4, 2, 0, 1]])


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return open_dataset(generate(mixed_dataset(), str(tmp_path_factory.mktemp("mixed") / "legs.zarr")).url)


def unit(dataset: Dataset, identity: int, pose: int) -> torch.Tensor:
    vertices = dataset.vertices(identity, pose)
    return torch.from_numpy(bounding_box(vertices).normalise(vertices))


def same(one: Batch, other: Batch) -> bool:
    pairs = ((one.source, other.source), (one.target, other.target), (one.truth, other.truth))
    counts = (one.source_counts, one.target_counts) == (other.source_counts, other.target_counts)
    return counts and all(torch.equal(a, b) for a, b in pairs) and same_edges(one.edges, other.edges)


def same_edges(one: torch.Tensor | PackedEdges, other: torch.Tensor | PackedEdges) -> bool:
    if isinstance(one, PackedEdges) and isinstance(other, PackedEdges):
        return torch.equal(one.pairs, other.pairs) and torch.equal(one.meshes, other.meshes)
    return isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor) and torch.equal(one, other)


def test_batches_hold_the_right_normalised_meshes(dataset: str) -> None:
    opened = open_dataset(dataset)
    triples = np.array([[3, 8, 4, 1], [4, 0, 3, 9]])
    batch = open_bank(opened, opened.identities("evaluation")).batch(triples)
    for row, (source, source_pose, target, target_pose) in enumerate(triples.tolist()):
        assert torch.equal(batch.source[row], unit(opened, source, source_pose))
        assert torch.equal(batch.target[row], unit(opened, target, target_pose))
        assert torch.equal(batch.truth[row], unit(opened, target, source_pose)), "target's identity in source's pose"
    assert batch.truth.abs().max() <= 1 + 1e-6
    assert torch.equal(batch.edges, torch.from_numpy(edges_of(opened.faces(3))))
    assert batch.source_counts is None and batch.target_counts is None
    assert same(batch, read_batch(opened, triples))


def test_meshes_of_many_counts_are_padded_with_zeros(mixed: Dataset) -> None:
    batch = open_bank(mixed, mixed.identities("training")).batch(TRIPLES)
    assert batch.source_counts == (32, 30, 30, 30) and batch.target_counts == (30, 30, 32, 32)
    assert batch.source.shape == batch.target.shape == batch.truth.shape == (4, 32, 3)
    for row, (source, source_pose, target, target_pose) in enumerate(TRIPLES.tolist()):
        for meshes, identity, pose in (
            (batch.source, source, source_pose),
            (batch.target, target, target_pose),
            (batch.truth, target, source_pose),
        ):
            count = MIXED_COUNTS[identity % 3]
            assert torch.equal(meshes[row, :count], unit(mixed, identity, pose))
            assert (meshes[row, count:] == 0).all()
    assert same(batch, read_batch(mixed, TRIPLES, padded=True))
    assert len(MixedCounts(DSFFNet(encoder_widths=(4, 4, 4), decoder_widths=(4, 4, 4)))(
        source=batch.source, target=batch.target, source_counts=batch.source_counts, target_counts=batch.target_counts
    )) == 4  # fmt: skip


def test_a_batch_of_equal_counts_and_one_topology_is_a_plain_one_in_any_bank(mixed: Dataset) -> None:
    bank = open_bank(mixed, mixed.identities("training"))
    batch = bank.batch(np.array([[1, 0, 4, 1], [2, 2, 1, 3]]))
    assert batch.source_counts is None and batch.target_counts is None and batch.target.shape == (2, 30, 3)
    assert torch.equal(batch.edges, torch.from_numpy(edges_of(mixed.faces(1))))
    other = bank.batch(np.array([[4, 0, 1, 1], [1, 2, 2, 3]]))
    assert other.target_counts is None and isinstance(other.edges, PackedEdges), "equal counts, other faces"


def test_packed_edges_are_each_meshs_own_edges(mixed: Dataset) -> None:
    batch = open_bank(mixed, mixed.identities("training")).batch(TRIPLES)
    assert isinstance(batch.edges, PackedEdges)
    flat = batch.truth.reshape(-1, 3)
    packed = (flat[batch.edges.pairs[:, 0]] - flat[batch.edges.pairs[:, 1]]).norm(dim=1)
    for row, (_, source_pose, target, _) in enumerate(TRIPLES.tolist()):
        first, second = torch.from_numpy(edges_of(mixed.faces(target))).T
        mesh = unit(mixed, target, source_pose)
        assert torch.equal(packed[batch.edges.meshes == row], (mesh[first] - mesh[second]).norm(dim=1))
    assert (batch.edges.meshes.diff() >= 0).all()


def test_how_packed_edges_touch_is_known_without_sorting_them(mixed: Dataset) -> None:
    """Put together from each topology's, it is what sorting the batch's edges gives, to the order of every sum."""
    bank = open_bank(mixed, mixed.identities("training"))
    batches = [bank.batch(triples) for triples in (TRIPLES, TRIPLES[::-1], TRIPLES[:3])]
    for batch in batches:
        assert isinstance(batch.edges, PackedEdges)
        rows = batch.target.shape[0] * batch.target.shape[1]
        found = INCIDENCES[batch.edges.pairs]
        assert incidence_of(batch.edges.pairs, rows) is found
        for one, other in zip(found, make_incidence(batch.edges.pairs, rows), strict=True):
            assert torch.equal(one, other) and one.dtype == other.dtype


def test_edges_of_faces_have_the_mean_of_the_faces_sums(mixed: Dataset) -> None:
    sides = EdgeTable(mixed, [0], device="cpu", of="faces").of(np.array([0]), rows=32)
    assert isinstance(sides, torch.Tensor)
    mesh = unit(mixed, 0, 0)
    corners = mesh[torch.from_numpy(mixed.faces(0)).long()]
    sums = (corners - corners.roll(-1, dims=1)).norm(dim=2).sum(dim=1)
    means = (mesh[sides[:, 0]] - mesh[sides[:, 1]]).norm(dim=1).mean()
    torch.testing.assert_close(3 * means, sums.mean())


def test_part_of_a_batch_is_the_batch_of_those_triples(mixed: Dataset) -> None:
    """Its edges too, whose rows count from the part's first mesh."""
    whole = read_batch(mixed, TRIPLES, padded=True)
    part = whole.part(1, 3)
    assert len(part) == 2 and isinstance(whole.edges, PackedEdges) and isinstance(part.edges, PackedEdges)
    rows = whole.target.shape[1]
    flat, of_part = whole.target.reshape(-1, 3), part.target.reshape(-1, 3)
    inside = (whole.edges.meshes >= 1) & (whole.edges.meshes < 3)
    assert torch.equal(of_part[part.edges.pairs], flat[whole.edges.pairs[inside]])
    assert torch.equal(part.edges.meshes, part.edges.pairs[:, 0] // rows)
    assert part.target_counts == whole.target_counts[1:3] and torch.equal(part.truth, whole.truth[1:3])


def test_surfaces_are_those_of_each_mesh_alone(mixed: Dataset) -> None:
    assert read_batch(mixed, TRIPLES, padded=True).surfaces is None
    batch = read_batch(mixed, TRIPLES, padded=True, surfaces=True).part(1, 4).to("cpu")
    assert batch.surfaces is not None
    for told, own in zip(batch.surfaces, (TRIPLES[1:, :2], TRIPLES[1:, 2:]), strict=True):
        for cells, near, (identity, pose) in zip(*told, own.tolist(), strict=True):
            vertices, faces = mixed.vertices(identity, pose), mixed.faces(identity)
            alone, count = surface_of(vertices, edges_of(faces)), len(vertices)
            expected = alone.near[0][alone.cells[0]][:, alone.cells[0]]
            assert torch.equal(near[cells[:count]][:, cells[:count]], expected)
            assert not expected.all()


def test_a_quarter_of_the_sources_is_not_told_the_same_ones_in_any_part(dataset: str) -> None:
    opened = open_dataset(dataset)
    triples = np.tile([[0, 1, 1, 2]], (64, 1))
    table = RigTable(BodiesAtRest(opened, opened.identities("training")), LEG, device="cpu")
    augmentation = Augmentation(tiny_training(**PARTS), table)
    bank = open_bank(opened, opened.identities("training"))
    whole = augmentation(triples, bank.batch(triples), step=3, first=0).surfaces
    half = augmentation(triples[32:], bank.batch(triples[32:]), step=3, first=32).surfaces
    assert whole is not None and half is not None
    untold = whole[0].near.all(dim=2).all(dim=1)
    assert 6 <= int(untold.sum()) <= 26 and not whole[1].near.all(dim=2).all(dim=1).any()
    assert torch.equal(half[0].near.all(dim=2).all(dim=1), untold[32:])


def test_reading_mixed_counts_must_be_asked_for(mixed: Dataset) -> None:
    with pytest.raises(DatasetError, match=r"mixes vertex counts \(30 to 32\)"):
        read_batch(mixed, TRIPLES)


def augmented(mixed: Dataset, *, step: int, ranks: int = 1, parts: int = 1, **changes: float) -> Iterator[Batch]:
    """The batch of a step as all ranks and parts have it, mesh by mesh."""
    identities = mixed.identities("training")
    order = TripleOrder(identities, mixed.grid.poses("seen"), batch=8, seed=1)
    augment, bank = Augmentation(tiny_training(augmentation=changes, seed=1)), open_bank(mixed, identities)
    for rank in range(ranks):
        share = {"rank": rank, "ranks": ranks, "parts": parts}
        first_places, triples = order.places(**share), next(order.batches(first_step=step, **share))
        for first, part in zip(first_places, triples, strict=True):
            yield augment(part, bank.batch(part), step=step, first=first)


def sources(batches: Iterator[Batch]) -> list[np.ndarray]:
    found = []
    for batch in batches:
        counts = batch.source_counts or [batch.source.shape[1]] * len(batch.source)
        found += [mesh[:count].numpy() for mesh, count in zip(batch.source, counts, strict=True)]
    return found


@pytest.mark.parametrize(("ranks", "parts"), [(2, 1), (1, 4), (2, 2)])
def test_augmentation_is_the_same_for_any_ranks_and_parts(mixed: Dataset, ranks: int, parts: int) -> None:
    changes = {"vertices": 0.5, "source_noise": 0.1, "source_holes": 0.5, "turn": 20}
    alone = sources(augmented(mixed, step=3, **changes))
    shared = sources(augmented(mixed, step=3, ranks=ranks, parts=parts, **changes))
    assert len(alone) == 8 and all(np.array_equal(a, b) for a, b in zip(alone, shared, strict=True))


def test_subsets_are_rows_of_the_source_in_its_order_and_others_each_time(mixed: Dataset) -> None:
    whole, subsets = (sources(augmented(mixed, step=2, vertices=part)) for part in (1.0, 0.5))
    chosen = []
    for mesh, subset in zip(whole, subsets, strict=True):
        assert len(subset) == round(0.5 * len(mesh))
        rows = [int(np.flatnonzero((mesh == vertex).all(axis=1))[0]) for vertex in subset]
        assert sorted(rows) == rows and len(set(rows)) == len(rows)
        chosen.append(tuple(rows))
    assert len(set(chosen)) == len(chosen), "another subset for every mesh"
    (batch,) = augmented(mixed, step=2, vertices=0.5)
    (plain,) = augmented(mixed, step=2)
    assert batch.source_counts is not None and batch.source.shape[1] == max(batch.source_counts)
    assert torch.equal(batch.target, plain.target) and torch.equal(batch.truth, plain.truth)


def test_a_step_takes_so_many_vertices_and_edges_between_them(mixed: Dataset) -> None:
    (whole,), (batch,) = (augmented(mixed, step=2, subset=size) for size in (None, 20))
    assert batch.source.shape == batch.target.shape == batch.truth.shape == (8, 20, 3)
    assert batch.source_counts is None and batch.target_counts is None
    assert batch.source_rows is not None and batch.target_rows is not None and isinstance(batch.edges, PackedEdges)
    assert isinstance(whole.edges, PackedEdges)
    for mesh in range(8):
        source, target = batch.source_rows[mesh], batch.target_rows[mesh]
        assert torch.equal(batch.source[mesh], whole.source[mesh, source]) and len(source.unique()) == 20
        assert torch.equal(batch.target[mesh], whole.target[mesh, target]) and len(target.unique()) == 20
        assert torch.equal(batch.truth[mesh], whole.truth[mesh, target])
        own = batch.edges.part(mesh, mesh + 1, rows=20).pairs
        known = {tuple(pair) for pair in whole.edges.part(mesh, mesh + 1, rows=whole.target.shape[1]).pairs.tolist()}
        assert len(own) == 5 and {tuple(pair) for pair in target[own].tolist()} <= known
    assert len({tuple(rows.tolist()) for rows in (*batch.source_rows, *batch.target_rows)}) == 16


def test_a_mesh_of_fewer_vertices_gives_some_twice_and_the_parts_network_gets_no_edges(mixed: Dataset) -> None:
    (batch,) = augmented(mixed, step=2, subset=40)
    assert batch.target.shape == (8, 40, 3) and batch.source_rows is not None
    (whole,) = augmented(mixed, step=2)
    assert isinstance(batch.edges, PackedEdges) and isinstance(whole.edges, PackedEdges)
    assert batch.target_rows is not None and whole.source_counts and whole.target_counts
    for meshes, of_whole, its_rows, counts in (
        (batch.source, whole.source, batch.source_rows, whole.source_counts),
        (batch.target, whole.target, batch.target_rows, whole.target_counts),
        (batch.truth, whole.truth, batch.target_rows, whole.target_counts),
    ):
        for mesh, before, rows, count in zip(meshes, of_whole, its_rows, counts, strict=True):
            assert torch.equal(mesh, before[rows]) and set(rows.tolist()) == set(range(count)), "all, and no others"
    for mesh, rows in enumerate(batch.target_rows):
        own = batch.edges.part(mesh, mesh + 1, rows=40).pairs
        known = whole.edges.part(mesh, mesh + 1, rows=whole.target.shape[1]).pairs
        assert len(own) == 10 and own.min() >= 0 and own.max() < 40
        assert {tuple(pair) for pair in rows[own].tolist()} <= {tuple(pair) for pair in known.tolist()}
    plain = open_bank(mixed, mixed.identities("training")).batch(TRIPLES)
    thinned = Augmentation(tiny_training(**PARTS))(TRIPLES, plain, step=0, first=0)
    assert isinstance(thinned.edges, PackedEdges) and len(thinned.edges.pairs) == 0


@pytest.mark.parametrize("subset", [20, 40])
@pytest.mark.parametrize("triples", [TRIPLES, np.array([[0, 1, 1, 2], [1, 3, 4, 0]])], ids=["many", "one"])
def test_every_edge_of_a_mesh_is_drawn_about_as_often(mixed: Dataset, triples: np.ndarray, subset: int) -> None:
    """Whether targets are of many topologies, or of one."""
    whole = open_bank(mixed, mixed.identities("training")).batch(triples)
    assert isinstance(whole.edges, PackedEdges) == (len(triples) > 2)
    augment = Augmentation(tiny_training(augmentation={"subset": subset}))
    found = [Counter[tuple[int, int]]() for _ in triples]
    for step in range(400):
        batch = augment(triples, whole, step=step, first=0)
        assert isinstance(batch.edges, PackedEdges) and batch.target_rows is not None
        for mesh, rows in enumerate(batch.target_rows):
            own = batch.edges.part(mesh, mesh + 1, rows=subset).pairs
            found[mesh].update((first, second) for first, second in rows[own].tolist())
    for counts, target in zip(found, triples[:, 2].tolist(), strict=True):
        edges = [(first, second) for first, second in edges_of(mixed.faces(target)).tolist()]
        mean = 400 * (subset // 4) / len(edges)
        assert sorted(counts) == sorted(edges)
        assert sum((counts[edge] - mean) ** 2 / mean for edge in edges) == pytest.approx(len(edges), rel=0.6)


def test_meshes_are_turned_about_the_vertical_and_boxed_anew(mixed: Dataset) -> None:
    (plain,), (batch,) = (augmented(mixed, step=2, turn=turn) for turn in (0, 25))
    angles = []
    for role in ("source", "target", "truth"):
        counts = (batch.source_counts if role == "source" else batch.target_counts) or ()
        for before, after, count in zip(getattr(plain, role), getattr(batch, role), counts, strict=True):
            low, high = after[:count].aminmax(dim=0)
            assert (high - low).max() == pytest.approx(2, rel=1e-5) and (low + high).abs().max() < 1e-5
            assert torch.count_nonzero(after[count:]) == 0
            turn, _ = Rotation.align_vectors(*(each[:count] - each[:count].mean(0) for each in (after, before)))
            x, y, z = turn.as_euler("xyz", degrees=True)
            assert abs(x) < 0.01 and abs(z) < 0.01
            angles.append(round(float(y), 1))
    sources, targets, truths = np.split(np.array(angles), 3)
    assert np.allclose(sources, truths, atol=0.11) and np.abs(angles).max() < 25.1
    assert len(set(sources)) == 8 and np.abs(sources - targets).min() > 0.05


def test_meshes_are_tilted_to_any_side_a_little_more_often_than_much(mixed: Dataset) -> None:
    leans, sides = list[float](), list[float]()
    for step in range(6):
        (plain,), (batch,) = (augmented(mixed, step=step, lean=lean) for lean in (0, 40))
        found = dict[str, list[Rotation]]()
        for role in ("source", "target", "truth"):
            counts = (batch.source_counts if role == "source" else batch.target_counts) or ()
            pairs = zip(getattr(plain, role), getattr(batch, role), counts, strict=True)
            cut = [[each[:count] - each[:count].mean(0) for each in (after, before)] for before, after, count in pairs]
            found[role] = [Rotation.align_vectors(*pair)[0] for pair in cut]
        for source, truth in zip(found["source"], found["truth"], strict=True):
            assert (source.inv() * truth).magnitude() < 0.01
        vectors = np.stack([turn.as_rotvec(degrees=True) for turn in found["source"] + found["target"]])
        assert np.abs(vectors[:, 1]).max() < 0.2, "about horizontal axes"
        leans += np.linalg.norm(vectors, axis=1).tolist()
        sides += np.arctan2(vectors[:, 2], vectors[:, 0]).tolist()
    assert max(leans) < 40.1 and max(leans) > 25 and np.median(leans) == pytest.approx(10, abs=5)
    assert np.histogram(sides, 4, (-np.pi, np.pi))[0].min() > 10 and len(set(leans)) == len(leans)


def test_noise_has_another_deviation_up_to_the_largest_each_time(mixed: Dataset) -> None:
    deviations = list[float]()
    for step in range(8):
        plain, noisy = (sources(augmented(mixed, step=step, source_noise=amount)) for amount in (0.0, 0.2))
        assert abs(np.concatenate(noisy) - np.concatenate(plain)).mean() < 0.1
        deviations += [float((b - a).std()) for a, b in zip(plain, noisy, strict=True)]
    assert 0.15 < max(deviations) < 0.25 and min(deviations) < 0.01 and len(set(deviations)) == len(deviations)
    assert np.median(deviations) == pytest.approx(0.05, abs=0.03), "0.2 times the square of a uniform number"


def test_a_source_that_is_cut_and_thinned_knows_which_of_its_vertices_are_left(mixed: Dataset) -> None:
    (plain,), (cut,), (both,) = (
        augmented(mixed, step=2, **changes)
        for changes in ({}, {"source_holes": 0.5}, {"source_holes": 0.5, "vertices": 0.5})
    )
    assert both.source_rows is not None and both.source_counts is not None and cut.source_counts is not None
    assert all(half == round(whole / 2) for half, whole in zip(both.source_counts, cut.source_counts, strict=True))
    for mesh, own, rows, count in zip(plain.source, both.source, both.source_rows, both.source_counts, strict=True):
        sizes = [float(torch.pdist(each).max()) for each in (mesh[rows[:count]], own[:count])]
        torch.testing.assert_close(torch.pdist(own[:count]), torch.pdist(mesh[rows[:count]]) * (sizes[1] / sizes[0]))
        assert not own[count:].any()


def test_a_hole_is_what_lies_about_a_vertex_and_the_rest_has_a_box_of_its_own(mixed: Dataset) -> None:
    (plain,), (batch,) = (augmented(mixed, step=2, source_holes=share) for share in (0, 0.9))
    assert batch.source_counts is not None and plain.source_counts is not None and batch.source_rows is not None
    assert torch.equal(batch.target, plain.target) and torch.equal(batch.truth, plain.truth)
    shares = list[float]()
    for mesh, cut, rows, whole, left in zip(
        plain.source, batch.source, batch.source_rows, plain.source_counts, batch.source_counts, strict=True
    ):
        kept = rows[:left]
        gone = np.setdiff1d(np.arange(whole), kept)
        shares.append(len(gone) / whole)
        low, high = cut[:left].aminmax(dim=0)
        assert (high - low).max() == pytest.approx(2, rel=1e-5) and (low + high).abs().max() < 1e-5
        scaled = mesh[kept] - mesh[kept].aminmax(dim=0)[0]
        torch.testing.assert_close(cut[:left] - low, scaled * (2 / scaled.max()), rtol=0, atol=1e-5)
        inside = [float((mesh[gone] - mesh[own]).norm(dim=1).max()) for own in gone]
        outside = [float((mesh[kept] - mesh[own]).norm(dim=1).min()) for own in gone]
        assert not inside or any(a <= b + 1e-6 for a, b in zip(inside, outside, strict=True)), "a ball about one"
    assert 0.1 < max(shares) <= 0.9 and len(set(shares)) > 3 and np.median(shares) < 0.3, "small ones more often"


def test_without_augmentation_the_batch_is_left_alone(mixed: Dataset) -> None:
    batch = open_bank(mixed, mixed.identities("training")).batch(TRIPLES)
    assert Augmentation(tiny_training())(TRIPLES, batch, step=0, first=0) is batch


def test_a_shuffled_batch_lists_each_targets_own_vertices_in_another_order_and_back(mixed: Dataset) -> None:
    batch = open_bank(mixed, mixed.identities("training")).batch(TRIPLES)
    assert batch.target_counts is not None
    shuffle, later = (Shuffle(batch, seed=1, step=step) for step in (5, 6))
    shuffled = shuffle(batch.target)
    for mesh, other, count in zip(batch.target, shuffled, batch.target_counts, strict=True):
        assert not torch.equal(mesh[:count], other[:count]) and torch.equal(mesh[count:], other[count:])
        assert sorted(map(tuple, mesh[:count].tolist())) == sorted(map(tuple, other[:count].tolist()))
    assert torch.equal(shuffle.undone(shuffled), batch.target)
    assert not torch.equal(later(batch.target), shuffled), "another order at each step"
    assert torch.equal(Shuffle(batch, seed=1, step=5)(batch.target), shuffled), "the same order for every rank and part"
