"""Bodies of other proportions fit what is said of them, and only some triples have them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from datagen.store import Dataset, open_dataset
from tests.support.recipes import LEG, PARTS, tiny_training
from training.data.augmentation.augment import Augmentation
from training.data.augmentation.proportions import of_other_proportions
from training.data.batch import Batch
from training.data.rigs.bodies_at_rest import BodiesAtRest
from training.data.rigs.rig_table import RigTable
from training.data.row_random import RowRandom
from training.data.vertex_bank import open_bank
from training.networks.layers.rigid_parts import ancestors, moved_joints, skinned

TRIPLES = np.array([[number % 3, number % 5, (number + 1) % 3, (number + 2) % 5] for number in range(24)])
PARENTS, ABOVE = torch.tensor([0, 0]), ancestors([-1, 0])


@pytest.fixture
def legs(dataset: str) -> Dataset:
    return open_dataset(dataset)


@pytest.fixture
def told(legs: Dataset) -> Batch:
    table = RigTable(BodiesAtRest(legs, legs.identities("training")), LEG, device="cpu")
    return table.posed(TRIPLES, open_bank(legs, legs.identities("training")).batch(TRIPLES))


def resized(told: Batch, deviation: float = 0.3) -> Batch:
    return of_other_proportions(told, deviation, LEG, random_of(told))


def random_of(batch: Batch) -> RowRandom:
    return RowRandom.of_batch(0, 0, first=0, rows=len(batch), device="cpu")


def test_half_of_the_triples_change_and_the_others_are_left_as_they_are(told: Batch) -> None:
    batch = resized(told)
    same = [torch.equal(a, b) for a, b in zip(batch.source, told.source, strict=True)]
    assert 6 < sum(same) < 18
    assert batch.posed is not None and told.posed is not None
    for row, is_same in enumerate(same):
        for before, after in ((told, batch), (told.posed[1], batch.posed[1])):
            for name in ("target", "truth") if before is told else ("rest", "joints", "rest_joints"):
                assert torch.equal(getattr(before, name)[row], getattr(after, name)[row]) == is_same


def test_vertices_are_the_body_at_rest_posed_as_is_said(told: Batch) -> None:
    batch = resized(told)
    assert batch.posed is not None
    for meshes, posed in ((batch.source, batch.posed[0]), (batch.target, batch.posed[1])):
        joints = moved_joints(posed.rest_joints, posed.rotations, PARENTS, ABOVE)
        vertices = skinned(posed.rest, posed.weights, posed.rotations, posed.rest_joints, joints)
        low, high = vertices.aminmax(dim=1, keepdim=True)
        half = ((high - low) / 2).amax(dim=2, keepdim=True)
        torch.testing.assert_close(meshes, (vertices - (low + high) / 2) / half, atol=2e-3, rtol=0)
        torch.testing.assert_close(posed.joints, (joints - (low + high) / 2) / half, atol=2e-3, rtol=0)
        span = (posed.rest.amax(1) - posed.rest.amin(1)).amax(1)
        torch.testing.assert_close(span, torch.full_like(span, 2), rtol=1e-4, atol=0)


def test_the_truth_is_the_targets_body_in_the_sources_pose(told: Batch) -> None:
    batch = resized(told)
    assert batch.posed is not None
    source, body = batch.posed
    joints = moved_joints(body.rest_joints, source.rotations, PARENTS, ABOVE)
    truth = skinned(body.rest, body.weights, source.rotations, body.rest_joints, joints)
    truth = truth - truth.mean(1, keepdim=True)
    found = batch.truth - batch.truth.mean(1, keepdim=True)
    scale = (truth * found).sum((1, 2)) / truth.square().sum((1, 2))
    torch.testing.assert_close(found, truth * scale[:, None, None], atol=3e-3, rtol=0)


def test_bones_of_a_part_grow_with_it_and_none_at_all_without_a_deviation(told: Batch) -> None:
    assert told.posed is not None
    batch = resized(told, deviation=0)
    torch.testing.assert_close(batch.source, told.source, atol=2e-3, rtol=0)
    batch = resized(told)
    assert batch.posed is not None
    before, after = (each.rest_joints[:, 1].norm(dim=1) for each in (told.posed[1], batch.posed[1]))
    assert float((after / before).min()) < 0.95 and float((after / before).max()) > 1.05


def test_a_batch_is_told_of_its_rigs_before_its_bodies_change_and_made_noisy_after(legs: Dataset) -> None:
    """What an augmentation does in a row fits together: vertices but for the noise are the bodies that are told of."""
    table = RigTable(BodiesAtRest(legs, legs.identities("training")), LEG, device="cpu")
    batch = open_bank(legs, legs.identities("training")).batch(TRIPLES)
    about: dict[str, float] = {"subset": 24, "turn": 25, "source_holes": 0.3, "proportions": 0.3}
    quiet, noisy = (
        Augmentation(tiny_training(**{**PARTS, "augmentation": {**about, **more}}), table)(
            TRIPLES, batch, step=1, first=0
        )
        for more in ({}, {"source_noise": 0.2})
    )
    assert quiet.posed is not None and noisy.posed is not None
    assert torch.equal(quiet.posed[0].joints, noisy.posed[0].joints), "noise comes last"
    assert not torch.equal(quiet.source, noisy.source) and torch.equal(quiet.target, noisy.target)
    for meshes, posed in ((quiet.source, quiet.posed[0]), (quiet.target, quiet.posed[1])):
        joints = moved_joints(posed.rest_joints, posed.rotations, PARENTS, ABOVE)
        vertices = skinned(posed.rest, posed.weights, posed.rotations, posed.rest_joints, joints)
        for mesh, its in zip(meshes, vertices, strict=True):
            own, right = mesh - mesh.mean(0), its - its.mean(0)
            scale = (own * right).sum() / right.square().sum()
            torch.testing.assert_close(own, right * scale, atol=1e-2, rtol=0)


def test_left_and_right_are_alike(legs: Dataset) -> None:
    joints = {"left_hip": None, "left_knee": "left_hip"}
    both: dict[str, str | None] = {"pelvis": None, **{a: b or "pelvis" for a, b in joints.items()}}
    both |= {a.replace("left", "right"): (b or "pelvis").replace("left", "right") for a, b in joints.items()}
    table = RigTable(BodiesAtRest(legs, legs.identities("training")), both, device="cpu")
    told = table.posed(TRIPLES, open_bank(legs, legs.identities("training")).batch(TRIPLES))
    assert told.posed is not None
    mirrored = told.posed[0].rest_joints * 0 + torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    told = replace(told, posed=tuple(replace(each, rest_joints=mirrored) for each in told.posed))
    batch = of_other_proportions(told, 0.3, both, random_of(told))
    assert batch.posed is not None
    names = list(both)
    knees = [names.index(f"{side}_knee") for side in ("left", "right")]
    hips = [names.index(f"{side}_hip") for side in ("left", "right")]
    rested = batch.posed[0].rest_joints
    lengths = [(rested[:, knee] - rested[:, hip]).norm(dim=1) for knee, hip in zip(knees, hips, strict=True)]
    own = [(mirrored[:, knee] - mirrored[:, hip]).norm(dim=1) for knee, hip in zip(knees, hips, strict=True)]
    torch.testing.assert_close(lengths[0] / own[0], lengths[1] / own[1], rtol=1e-4, atol=0)
