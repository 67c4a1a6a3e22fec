"""The field around a person of Anny: bones, folds of space, and the way back from a pose."""

import numpy as np
import pytest
import torch

from datagen.bodies import load_body
from datagen.bodies.anny.model import AnnyModel
from datagen.mesh.rig import skinned
from datagen.poses import JOINTS, PARENTS, Poses
from datagen.recipe import AnnyBody
from training.avatar.body import CanonicalBody, canonical_body
from training.avatar.diffusion import SkinningField, diffused_skinning
from training.avatar.roots import TransformField, canonical_roots, fold_over, starting_bones
from training.avatar.solid import Solid

pytestmark = pytest.mark.slow
SITTING = {"left_hip": (-90, 0, 8), "right_hip": (-90, 0, -8), "left_knee": (85, 0, 0), "right_knee": (85, 0, 0)}
LEG_LIFTED = {"left_hip": (-80, 0, 0), "left_knee": (40, 0, 0)}


@pytest.fixture(scope="module")
def body() -> CanonicalBody:
    model, person = load_body(AnnyBody(topology="anny")), np.full(6, 0.6)
    assert isinstance(model, AnnyModel)
    return canonical_body(model.rig(person, JOINTS), model.rest(person).vertices, model.faces(person), JOINTS, PARENTS)


@pytest.fixture(scope="module")
def field(body: CanonicalBody) -> SkinningField:
    return diffused_skinning(body)


def transforms(body: CanonicalBody, turned: dict[str, tuple[int, int, int]]) -> torch.Tensor:
    rotations = np.zeros((1, len(JOINTS), 3))
    for joint, turn in turned.items():
        rotations[0, JOINTS.index(joint)] = np.radians(turn)
    return torch.from_numpy(body.transforms(Poses(JOINTS, PARENTS, rotations).world(), JOINTS)[0]).float()


def test_thirty_bones_carry_a_joint(body: CanonicalBody) -> None:
    assert len(body.names) == 30 and body.hands.sum() == 10
    assert sorted({driver for driver in body.drivers if driver}) == sorted(JOINTS)


@pytest.mark.parametrize("turned", [SITTING, LEG_LIFTED])
def test_space_hardly_folds_near_the_skin(body: CanonicalBody, field: SkinningField, turned: dict) -> None:
    cells = field.cells().reshape(-1, 3).float()
    near = torch.from_numpy(np.abs(Solid(body.vertices, body.faces).depth(cells.numpy())) < 0.05)
    folded = fold_over(TransformField.of(field, transforms(body, turned)), cells[near])
    assert folded.float().mean() < 0.02


def test_the_skin_is_found_again(body: CanonicalBody, field: SkinningField) -> None:
    moved = transforms(body, LEG_LIFTED)
    posed = torch.from_numpy(skinned(body.vertices, body.weights, moved[None].numpy())[0]).float()[::5]
    roots = canonical_roots(TransformField.of(field, moved), posed, moved, starting_bones(body))
    away = (roots.points - torch.from_numpy(body.vertices).float()[::5, None]).norm(dim=2)
    assert (away.where(roots.valid, torch.inf).amin(dim=1) < 0.01).float().mean() > 0.99
