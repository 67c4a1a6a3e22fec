"""Canonical points are found again from posed ones; where space overlaps, all of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.shapes.canonical import posed_leg
from training.avatar.diffusion import SkinningField, diffused_skinning
from training.avatar.roots import TransformField, canonical_roots, fold_over, starting_bones

BOTH = torch.tensor([0, 1])


@pytest.fixture(scope="module")
def field() -> SkinningField:
    return diffused_skinning(posed_leg().body, centres=200, spacing=0.02)


def in_pose(field: SkinningField, pose: int) -> tuple[TransformField, torch.Tensor]:
    transforms = torch.from_numpy(posed_leg().transforms[pose]).float()
    return TransformField.of(field, transforms), transforms


@pytest.mark.parametrize("pose", range(4))
def test_skin_goes_back_to_its_canonical_place(field: SkinningField, pose: int) -> None:
    moved, transforms = in_pose(field, pose)
    canonical = torch.from_numpy(posed_leg().body.vertices).float()
    roots = canonical_roots(moved, moved.posed(canonical), transforms, BOTH)
    away = (roots.points - canonical[:, None]).norm(dim=2).where(roots.valid, torch.inf).amin(dim=1)
    assert (away < 0.002).float().mean() > 0.99
    posed = moved.posed(roots.points[roots.valid])
    wanted = moved.posed(canonical)[:, None].expand(-1, 3, -1)[roots.valid]
    assert (posed - wanted).norm(dim=1).max() < 1e-4


def test_roots_of_a_body_as_its_model_poses_it_are_near(field: SkinningField) -> None:
    moved, transforms = in_pose(field, 2)
    canonical = torch.from_numpy(posed_leg().body.vertices).float()
    roots = canonical_roots(moved, torch.from_numpy(posed_leg().posed[2]).float(), transforms, BOTH)
    away = (roots.points[:, 0] - canonical).norm(dim=1)
    assert roots.valid[:, 0].float().mean() > 0.99 and away.quantile(0.9) < 0.01


def test_a_blend_of_the_bones_is_what_poses_a_point(field: SkinningField) -> None:
    moved, transforms = in_pose(field, 3)
    points = torch.from_numpy(posed_leg().body.vertices).float()
    matrices = torch.einsum("nb,bij->nij", field.weights(points), transforms)
    assert moved.matrices(points) == pytest.approx(matrices, abs=1e-5)


def test_one_root_is_told_once_and_one_beyond_the_box_not_at_all(field: SkinningField) -> None:
    still = torch.eye(3, 4).expand(2, 3, 4)
    points = torch.tensor([[0.0, -0.4, 0.0], [0.0, 5.0, 0.0]])
    roots = canonical_roots(TransformField.of(field, still), points, still, BOTH)
    assert roots.valid.tolist() == [[True, False, False], [False, False, False]]
    assert roots.points[0, 0] == pytest.approx(points[0], abs=1e-4)


def test_a_folded_leg_has_two_canonical_places_where_it_passes_through_itself(field: SkinningField) -> None:
    knee, turn = posed_leg().body.joints[1], np.diag([1.0, -1.0, -1.0])
    folded = torch.eye(3, 4).repeat(2, 1, 1)
    folded[1] = torch.from_numpy(np.concatenate([turn, (knee - turn @ knee)[:, None]], axis=1))
    within = torch.from_numpy(0.5 * knee + 0.5 * posed_leg().body.joints[0]).float()[None]
    roots = canonical_roots(TransformField.of(field, folded), within, folded, BOTH)
    assert roots.valid.sum() == 2 and (roots.points[0, 0] - roots.points[0, 1]).norm() > 0.2


def test_fold_over_is_where_space_is_turned_inside_out(field: SkinningField) -> None:
    cells = field.cells().reshape(-1, 3).float()
    mirrored = torch.eye(3, 4).repeat(2, 1, 1)
    assert not fold_over(TransformField.of(field, mirrored), cells).any()
    mirrored[:, 0, 0] = -1
    assert fold_over(TransformField.of(field, mirrored), cells).all()


def test_starts_are_the_bones_that_move_most_of_the_surface() -> None:
    body = posed_leg().body
    assert starting_bones(body).tolist() == [0, 1]
    thigh_is_larger = starting_bones(body, count=1).tolist()
    swapped = starting_bones(replace(body, weights=body.weights[:, ::-1]), count=1).tolist()
    assert thigh_is_larger == [0] and swapped == [1]
