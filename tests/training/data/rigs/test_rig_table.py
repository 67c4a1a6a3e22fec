"""What the parts network is told is what the dataset's rigs say, however a batch was turned and thinned."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from datagen.common.errors import RecipeError
from datagen.mesh.geometry import bounding_box, edges_of
from datagen.mesh.rig import world_rotations
from datagen.store import Dataset, open_dataset
from tests.support.recipes import LEG, PARTS, tiny_training
from training.data.augmentation.augment import Augmentation
from training.data.rigs import rig_table
from training.data.rigs.bodies_at_rest import BodiesAtRest
from training.data.rigs.rig_table import RigTable
from training.data.vertex_bank import open_bank
from training.networks.layers.surface import surface_of

TRIPLES = np.array([[0, 1, 1, 2], [1, 3, 2, 0], [2, 0, 1, 5]])


@pytest.fixture
def legs(dataset: str) -> Dataset:
    return open_dataset(dataset)


def table_of(legs: Dataset) -> RigTable:
    return RigTable(BodiesAtRest(legs, legs.identities("training")), LEG, device="cpu")


@pytest.mark.parametrize(("turn", "lean"), [(0, 0), (25, 0), (25, 40)])
@pytest.mark.parametrize("subset", [None, 24])
def test_rotations_joints_and_weights_are_those_of_the_rig(
    legs: Dataset, turn: int, lean: int, subset: int | None
) -> None:
    recipe = tiny_training(augmentation={"turn": turn, "lean": lean, "subset": subset})
    batch = open_bank(legs, legs.identities("training")).batch(TRIPLES)
    batch = told = Augmentation(recipe, table_of(legs))(TRIPLES, batch, step=3, first=0)
    assert told.posed is not None
    world = world_rotations(legs.rotations(), legs.attributes["joint_parents"])
    for said, meshes, rows, own in (
        (told.posed[0], batch.source, batch.source_rows, TRIPLES[:, :2]),
        (told.posed[1], batch.target, batch.target_rows, TRIPLES[:, 2:]),
    ):
        for place, (identity, pose) in enumerate(own.tolist()):
            rig, vertices = legs.rig(identity), legs.vertices(identity, pose)
            assert rig is not None
            kept = np.arange(len(vertices)) if rows is None else rows[place].numpy()
            np.testing.assert_allclose(said.weights[place], rig.weights[kept], atol=1e-6)
            transforms = rig.transforms(world[[pose]])[0]
            joints = (transforms[:, :, :3] @ rig.joints[..., None])[..., 0] + transforms[:, :, 3]
            found = said.rotations[place].double().numpy() @ np.linalg.inv(rig.rotations(world[pose]))
            np.testing.assert_allclose(found[0], found[1], atol=2e-4)  # one turn for all parts
            assert (abs(np.degrees(np.arctan2(found[0, 0, 2], found[0, 0, 0]))) > 0.5) == bool(turn)
            assert (np.degrees(np.arccos(np.clip(found[0, 1, 1], -1, 1))) > 0.3) == bool(lean)
            turned = (vertices @ found[0].T).astype(np.float64)
            box = bounding_box(turned)
            np.testing.assert_allclose(meshes[place], box.normalise(turned)[kept], atol=1e-3)
            np.testing.assert_allclose(said.joints[place], box.normalise(joints @ found[0].T), atol=1e-3)
    assert torch.equal(told.posed[0].present, torch.ones(3, 2))


def test_surfaces_are_of_the_vertices_that_a_step_takes(legs: Dataset) -> None:
    recipe = tiny_training(augmentation={"subset": 24, "source_holes": 0.3})
    batch = open_bank(legs, legs.identities("training")).batch(TRIPLES)
    whole = table_of(legs).posed(TRIPLES, batch).surfaces
    told = Augmentation(recipe, table_of(legs))(TRIPLES, batch, step=1, first=0)
    assert whole is not None and told.surfaces is not None
    for surface, every, rows in zip(told.surfaces, whole, (told.source_rows, told.target_rows), strict=True):
        assert rows is not None and torch.equal(surface.cells, every.cells.gather(1, rows))
    own = surface_of(legs.vertices(1, 0), edges_of(legs.faces(1)))
    among = [its.near[0][its.cells[0]][:, its.cells[0]] for its in (own, whole[1])]
    assert (among[0] == among[1]).float().mean() > 0.8  # in one pose nearly as in another
    assert torch.equal(told.surfaces[1].near, whole[1].near)


def test_surfaces_are_of_each_kind_of_body_in_several_poses(legs: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lest cells be learned by heart. Of two kinds, as the second identity's weights differ, and three poses each."""
    monkeypatch.setattr(rig_table, "_SURFACES", 6)
    bodies = BodiesAtRest(legs, legs.identities("training"))
    bodies.rigs[1] = replace(bodies.rigs[1], weights=bodies.rigs[1].weights[::-1].copy())
    poses, edges = legs.grid.poses_of(0), edges_of(legs.faces(0))
    triples = np.array([[place % 3, pose, (place + 1) % 3, poses[place - 2]] for place, pose in enumerate(poses)])
    batch = open_bank(legs, legs.identities("training")).batch(triples)
    table = RigTable(bodies, LEG, device="cpu")
    for number in range(6):  # three of the first identity, three of the second
        own = surface_of(legs.vertices(number // 3, poses[number % 3 * len(poses) // 3]), edges)
        size = own.near.shape[1]
        assert torch.equal(table._surfaces.cells[number], own.cells[0])
        assert torch.equal(table._surfaces.near[number, :size, :size], own.near[0])
    assert len({tuple(cells) for cells in table._surfaces.cells.tolist()}) > 1
    table._surfaces.cells[:] = torch.arange(6)[:, None]
    told = table.posed(triples, batch)
    assert told.surfaces is not None
    for surface, meshes in zip(told.surfaces, (triples[:, :2], triples[:, 2:]), strict=True):
        expected = [3 * (identity == 1) + pose % 3 for identity, pose in meshes.tolist()]
        assert surface.cells[:, 0].tolist() == expected
    monkeypatch.setattr(rig_table, "_SURFACES", 1)
    assert len(RigTable(bodies, LEG, device="cpu")._surfaces.cells) == 2  # of each kind at least


def test_bodies_rest_at_their_root_in_their_own_size(legs: Dataset) -> None:
    batch = table_of(legs).posed(TRIPLES, open_bank(legs, legs.identities("training")).batch(TRIPLES))
    assert batch.posed is not None
    rest = batch.posed[1].rest
    span = (rest.amax(1) - rest.amin(1)).amax(1)
    torch.testing.assert_close(span, torch.full_like(span, 2.0), rtol=1e-4, atol=0)
    assert rest[..., 1].amax(1).abs().max() < 1e-3  # the hip is the top of a leg
    assert not torch.allclose(rest[0], rest[1], atol=1e-3)  # each identity its own


def test_a_part_that_a_body_lacks_is_said_to_be_absent(legs: Dataset) -> None:
    joints = {**LEG, "left_ankle": "left_knee"}
    table = RigTable(BodiesAtRest(legs, legs.identities("training")), joints, device="cpu")
    batch = table.posed(TRIPLES, open_bank(legs, legs.identities("training")).batch(TRIPLES))
    assert batch.posed is not None
    assert torch.equal(batch.posed[0].present, torch.tensor([[1.0, 1, 0]] * 3))


def test_a_dataset_without_rigs_or_with_other_joints_is_refused(legs: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RecipeError, match=r"names 'tail', which no pose of .* turns; its joints are pelvis, "):
        RigTable(BodiesAtRest(legs, [0]), {"left_hip": None, "tail": "left_hip"}, device="cpu")
    monkeypatch.setitem(vars(legs), "rig_numbers", np.full(5, -1))
    with pytest.raises(RecipeError, match=r"identity 0 of .* has no rig, .*Make a dataset of a body with a skeleton"):
        table_of(legs)


def test_the_same_joints_in_another_order_are_another_recipe() -> None:
    joints = {"pelvis": None, "left_hip": "pelvis", "right_hip": "pelvis"}
    other = {"pelvis": None, "right_hip": "pelvis", "left_hip": "pelvis"}
    one, two = (tiny_training(**PARTS | {"network": {"name": "parts", "joints": its}}) for its in (joints, other))
    one.require_same_learning(one, where="runs/x")
    with pytest.raises(RecipeError, match=r"training\.network"):
        two.require_same_learning(one, where="runs/x")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"augmentation": {}}, r"set augmentation\.subset"),
        ({"precision": "bfloat16"}, "knows no precision: take it away"),
        ({"compile": True}, "knows no compile: take it away"),
        ({"augmentation": {"subset": 24, "shuffle": True}}, r"knows no augmentation\.shuffle: take it away"),
        ({"augmentation": {"subset": 24, "vertices": 0.5}}, "both leave vertices out: take one away"),
        ({"network": {"name": "parts", "joints": {"knee": "hip"}}}, "'knee' comes before its parent 'hip'"),
    ],
)
def test_recipes_that_cannot_be_meant_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tiny_training(**{**PARTS, **changes})
