"""Recombined poses: meshes are what the rigs make of the joints' rotations, and these are of seen poses."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from datagen.common.errors import RecipeError
from datagen.generate import generate
from datagen.mesh.geometry import bounding_box
from datagen.mesh.rig import Rig, rest_vertices, skinned, world_rotations
from datagen.store import Dataset, open_dataset
from tests.support.recipes import LEG, PARTS, mixed_dataset, tiny_dataset, tiny_training
from training.data.augmentation.augment import Augmentation
from training.data.batch import Batch
from training.data.cache_policy import Room
from training.data.rigs.bodies_at_rest import BodiesAtRest
from training.data.rigs.posed_bodies import PosedBodies
from training.data.rigs.rig_table import RigTable
from training.data.vertex_bank import open_bank
from training.engine.distributed import Ranks
from training.engine.tasks.transfer.transfer_task import TransferTask

TRIPLES = np.array([[0, 1, 1, 2], [1, 3, 2, 0], [2, 0, 1, 5], [0, 4, 2, 3]])


@pytest.fixture
def legs(dataset: str) -> Dataset:
    return open_dataset(dataset)


def recombined(legs: Dataset, share: float = 1.0, *, step: int = 3, first: int = 0, **augmentation: Any) -> Batch:
    identities = legs.identities("training")
    recipe = tiny_training(
        network={"name": "parts", "joints": LEG, "width": 8, "token_width": 8, "blocks": 1},
        augmentation={"subset": 24, **augmentation, "recombined": share},
    )
    bodies = BodiesAtRest(legs, identities)
    rigs, posed = RigTable(bodies, LEG, device="cpu"), PosedBodies(bodies, device="cpu")
    batch = open_bank(legs, identities).batch(TRIPLES[first:])
    return Augmentation(recipe, rigs, posed)(TRIPLES[first:], batch, step=step, first=first)


def of_bodies_alone(legs: Dataset, share: float) -> tuple[Batch, Batch]:
    """What the bank has of the triples, and what becomes of it."""
    identities = legs.identities("training")
    recipe = tiny_training(augmentation={"recombined": share})
    batch = open_bank(legs, identities).batch(TRIPLES)
    augment = Augmentation(recipe, bodies=PosedBodies(BodiesAtRest(legs, identities), device="cpu"))
    return batch, augment(TRIPLES, batch, step=3, first=0)


def mesh(legs: Dataset, identity: int, turns: torch.Tensor) -> NDArray[np.float64]:
    """A body by its rig, boxed, where the pose joints are turned so [joint, 3, 3]."""
    rig = legs.rig(identity)
    assert rig is not None
    poses = legs.grid.poses_of(identity)[:8]
    world = world_rotations(legs.rotations(), legs.attributes["joint_parents"])[poses]
    posed = legs.vertices(identity, poses).astype(np.float64)
    rest = rest_vertices(posed, rig.weights, rig.transforms(world))
    vertices = skinned(rest, rig.weights, rig.transforms(turns[None].double().numpy()))[0]
    return bounding_box(vertices).normalise(vertices)


def _with_another_part(rig_of: Any) -> Any:
    """Rigs of which identity 1 has a part more that no joint turns, at the root, and half of some vertices' weight."""

    def rig(dataset: Dataset, identity: int) -> Rig:
        found = rig_of(dataset, identity)
        if identity != 1:
            return found
        weights = np.concatenate([found.weights, np.zeros((len(found.weights), 1), np.float32)], axis=1)
        weights[:9, -1], weights[:9, :-1] = 0.5, weights[:9, :-1] / 2
        return Rig(
            (*found.names, "stump"),
            (*found.parents, -1),
            (*found.drivers, -1),
            np.concatenate([found.corrections, np.eye(3)[None]]),
            weights,
            np.concatenate([found.joints, found.joints[:1] + 0.1]),
        )

    return rig


def local(turns: torch.Tensor, parents: list[int]) -> NDArray[np.float64]:
    world = turns.double().numpy()
    above = [np.eye(3) if parent < 0 else world[parent] for parent in parents]
    return np.stack([own.T @ its for own, its in zip(above, world, strict=True)])


@pytest.mark.parametrize("kind", ["alike", "mixed", "grown", "other rigs"])
def test_meshes_are_what_the_rigs_make_of_rotations_of_seen_poses(
    kind: str, legs: Dataset, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen poses after unseen ones, where a dataset has grown; rigs of one identity that have another part."""
    if kind in ("mixed", "grown"):
        growth = [{"training": 1, "evaluation": 0, "seen": 5, "unseen": 1}] if kind == "grown" else []
        recipe = tiny_dataset(growth=growth) if growth else mixed_dataset()
        legs = open_dataset(generate(recipe, str(tmp_path / "legs.zarr")).url)
    if kind == "other rigs":
        monkeypatch.setattr(Dataset, "rig", _with_another_part(Dataset.rig))
    before, batch = of_bodies_alone(legs, 1.0)
    assert batch.turns is not None
    parents, seen = legs.attributes["joint_parents"], legs.grid.poses("seen")
    world = torch.from_numpy(world_rotations(legs.rotations(), parents))
    known = [local(world[pose], parents) for pose in seen.tolist()]
    combinations = set[tuple[int, ...]]()
    for place, (source, _, target, _) in enumerate(TRIPLES.tolist()):
        of_source, of_target = (turns[place] for turns in batch.turns)
        for meshes, identity, turns in (
            (batch.source, source, of_source),
            (batch.target, target, of_target),
            (batch.truth, target, of_source),
        ):
            count = legs.vertex_count(identity)
            np.testing.assert_allclose(meshes[place, :count], mesh(legs, identity, turns), atol=2e-5)
            assert not meshes[place, count:].any()
        for turns in (of_source, of_target):
            own = local(turns, parents)
            away = np.array([np.abs(its - own).max(axis=(1, 2)) for its in known])
            assert away.min(axis=0).max() < 1e-5
            combinations.add(tuple(away.argmin(axis=0)[[1, 4]].tolist()))  # the hip and the knee
    assert any(hip != knee for hip, knee in combinations)
    assert before.edges is batch.edges and before.target_counts == batch.target_counts


def test_where_none_is_chosen_nothing_changes(legs: Dataset) -> None:
    before, batch = of_bodies_alone(legs, 1e-7)
    assert batch is before and batch.turns is None
    told, as_told = recombined(legs, 1e-7), recombined(legs, 0.0)
    assert told.turns is None and told.posed is not None and as_told.posed is not None
    assert torch.equal(told.source, as_told.source) and torch.equal(told.posed[0].joints, as_told.posed[0].joints)


def test_the_others_stay_as_they_are(legs: Dataset) -> None:
    before, batch = of_bodies_alone(legs, 0.5)
    changed = (batch.source != before.source).flatten(1).any(dim=1)
    assert changed.any() and not changed.all()
    assert batch.turns is not None
    world = world_rotations(legs.rotations(), legs.attributes["joint_parents"])
    for place in np.flatnonzero(~changed).tolist():
        for meshes in ("source", "target", "truth"):
            assert torch.equal(getattr(batch, meshes)[place], getattr(before, meshes)[place])
        for turns, pose in zip(batch.turns, TRIPLES[place, [1, 3]], strict=True):
            np.testing.assert_allclose(turns[place], world[pose], atol=1e-6)


def test_the_parts_network_is_told_of_the_poses_that_the_meshes_are_in(legs: Dataset) -> None:
    batch = recombined(legs, turn=20)
    assert batch.posed is not None and batch.turns is not None
    chosen = [legs.attributes["joints"].index(name) for name in LEG]
    for posed, turns in zip(batch.posed, batch.turns, strict=True):
        about = posed.rotations @ turns[:, chosen].mT  # the turn about the vertical, which all parts have
        torch.testing.assert_close(about[:, 0], about[:, 1], atol=2e-3, rtol=0)
        assert about[:, 0, 1, 1].min() > 0.9999


def test_a_batch_in_two_parts_is_the_same(legs: Dataset) -> None:
    whole, second = recombined(legs, 0.7, points=0.5), recombined(legs, 0.7, points=0.5, first=2)
    for meshes in ("source", "target", "truth"):
        torch.testing.assert_close(getattr(whole, meshes)[2:], getattr(second, meshes), atol=1e-6, rtol=0)
    assert whole.turns is not None and second.turns is not None
    assert all(torch.equal(one[2:], two) for one, two in zip(whole.turns, second.turns, strict=True))
    other = recombined(legs, 0.7, points=0.5, step=4)
    assert other.turns is not None and not torch.allclose(other.turns[0], whole.turns[0])


@pytest.mark.parametrize("accumulate", [1, 4])
@pytest.mark.parametrize("cache", ["device", "stream"])
def test_a_training_recombines_its_batches(legs: Dataset, accumulate: int, cache: str) -> None:
    """Parts of a single triple, of which some have none that is chosen."""
    augmentation = {"subset": 24, "recombined": 0.5}
    recipe = tiny_training(
        network=PARTS["network"], augmentation=augmentation, accumulate=accumulate, cache=cache, edge_weight=0
    )
    task = TransferTask(recipe, legs)
    task.check(Room("test", 2**30, 1.0), 1)
    with task.feed(Ranks(0, 1, 0), torch.device("cpu")) as feed:
        shares = [next(batches) for batches in [feed.batches(0)] for _ in range(4)]
    parts = [part for _, its in shares for part in its]
    assert len(parts) == 4 * accumulate and any(part.turns for part in parts)
    assert (accumulate == 1) or not all(part.turns for part in parts)
    assert all(part.posed is not None and part.source.shape == (4 // accumulate, 24, 3) for part in parts)


def test_the_papers_network_learns_from_recombined_poses_too(legs: Dataset) -> None:
    task = TransferTask(tiny_training(augmentation={"recombined": 1.0}, precision="float64"), legs)
    with task.feed(Ranks(0, 1, 0), torch.device("cpu")) as feed:
        _, (batch,) = next(feed.batches(0))
    assert batch.posed is None and batch.turns is not None and batch.surfaces is None


def test_bodies_are_posed_a_few_at_a_time(legs: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    _, together = of_bodies_alone(legs, 1.0)
    monkeypatch.setattr("training.data.rigs.posed_bodies._AT_ONCE", 1)
    _, apart = of_bodies_alone(legs, 1.0)
    for meshes in ("source", "target", "truth"):
        torch.testing.assert_close(getattr(apart, meshes), getattr(together, meshes), atol=1e-6, rtol=0)


def test_joints_that_turn_alike_stay_together(legs: Dataset) -> None:
    rotations = legs.rotations().copy()
    hip, knee = (legs.attributes["joints"].index(name) for name in LEG)
    rotations[:, knee] = rotations[:, hip]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Dataset, "rotations", lambda self: rotations)
        _, batch = of_bodies_alone(legs, 1.0)
    assert batch.turns is not None
    for turns in torch.cat(batch.turns):
        own = local(turns, legs.attributes["joint_parents"])
        np.testing.assert_allclose(own[hip], own[knee], atol=1e-5)


@pytest.mark.parametrize("changes", [PARTS, {"augmentation": {"recombined": 0.5}}, {}])
def test_a_training_without_the_rigs_that_it_needs_is_refused_before_meshes_are_decoded(
    changes: dict[str, Any], legs: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(vars(legs), "rig_numbers", np.array([0, 0, -1, -1, -1]))
    task, room = TransferTask(tiny_training(**changes), legs), Room("test", 2**30, 1.0)
    if not changes:
        task.check(room, 1)
        return
    with pytest.raises(RecipeError, match=r"identity 2 of .* has no rig"):
        task.check(room, 1)
