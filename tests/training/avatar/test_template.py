"""The template: its loss, its surface, its weights; and a small one learned from four poses of a leg."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from datagen.common.errors import CheckpointError, TrainingError
from datagen.mesh.geometry import Mesh
from datagen.mesh.surface_nets import surface_nets
from tests.support.shapes.canonical import posed_leg
from training.avatar.diffusion import SkinningField, diffused_skinning
from training.avatar.occupancy import FrameSamples, frame_samples
from training.avatar.solid import Solid
from training.avatar.template import (
    Template,
    extract_template,
    near_surface_iou,
    one_piece,
    plainest_pose,
    pose_condition,
    template_loss,
)
from training.checkpoints.weights import write_weights
from training.networks.template import OccupancyTemplate

NO_HANDS = torch.empty(0, 3), torch.empty(0, dtype=torch.bool)
NO_POSE = torch.zeros(69)


@pytest.fixture(scope="module")
def field() -> SkinningField:
    return diffused_skinning(posed_leg().body, centres=200)


def ball(points: Tensor, pose: Tensor) -> Tensor:
    """A ball of 8 cm around the knee, and a crumb."""
    knee = torch.from_numpy(posed_leg().body.joints[1]).float()
    crumb = 0.006 - (points - knee + torch.tensor([0.0, 0.3, 0.0])).norm(dim=-1)
    return torch.maximum(0.08 - (points - knee).norm(dim=-1), crumb)


def one(logits: list[float], valid: list[bool], inside: bool) -> tuple[Tensor, FrameSamples]:
    """A network that says these logits of the three roots of one point, and that point."""
    samples = FrameSamples(
        torch.zeros(1, 1, 3, 3), torch.tensor([[valid]]), torch.tensor([[inside]]), torch.ones(1, 1, dtype=torch.bool)
    )
    return torch.tensor([logits]), samples


def test_occupancy_is_the_soft_maximum_over_valid_roots() -> None:
    said, samples = one([2.0, -1.0, 9.0], [True, True, False], True)
    p = torch.tensor([2.0, -1.0]).sigmoid()
    expected = -((5 * p).softmax(0) * p).sum().log()
    assert template_loss(lambda points, pose: said, samples, NO_POSE[None], NO_HANDS) == pytest.approx(float(expected))


def test_hands_add_their_cross_entropy() -> None:
    said, samples = one([30.0, 0.0, 0.0], [True, False, False], True)
    hands = torch.zeros(4, 3), torch.tensor([True, True, False, True])

    def network(points: Tensor, pose: Tensor) -> Tensor:
        return said if points.shape[1] == 3 else torch.full((1, 4), 1.5)

    entropy = (3 * np.log1p(np.exp(-1.5)) + np.log1p(np.exp(1.5))) / 4
    assert template_loss(network, samples, NO_POSE[None], hands) == pytest.approx(entropy, abs=1e-5)


def test_iou_takes_the_maximum_over_roots_and_what_has_none_for_outside() -> None:
    valid = torch.tensor([[[True, True, False], [True, False, True], [False] * 3, [True, False, False]]])
    inside = torch.tensor([[True, False, True, True]])
    logits = torch.tensor([[[-1.0, 1, 0], [-1, 9, 1], [9, 9, 9], [2, 0, 0]]])
    samples = FrameSamples(torch.zeros(1, 4, 3, 3), valid, inside, torch.tensor([[True, True, True, False]]))
    assert near_surface_iou(lambda points, pose: logits.flatten(1), samples, NO_POSE[None]) == pytest.approx(1 / 3)


def test_the_surface_of_a_ball_without_its_crumb(field: SkinningField) -> None:
    made = extract_template(ball, NO_POSE, field, cell=0.01)
    knee = torch.from_numpy(posed_leg().body.joints[1]).float()
    outwards = made.vertices - knee
    assert outwards.norm(dim=1) == pytest.approx(torch.full((len(made.vertices),), 0.08), abs=0.002)
    assert made.euler_characteristic == 2
    assert ((made.normals * outwards).sum(dim=1) / 0.08).min() > 0.97
    assert torch.equal(made.weights, field.weights(made.vertices))


def test_a_hole_of_a_cell_through_a_ball_is_closed(field: SkinningField) -> None:
    knee = torch.from_numpy(posed_leg().body.joints[1]).float()

    def bored(points: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
        away = (points - knee)[..., [0, 2]].norm(dim=-1)
        return torch.where(away < 0.006, -torch.ones(away.shape), 100 * ball(points, pose))

    assert extract_template(bored, NO_POSE, field, cell=0.01).euler_characteristic == 2


def test_a_handle_that_is_no_cells_touching_stays(field: SkinningField) -> None:
    knee = torch.from_numpy(posed_leg().body.joints[1]).float()

    def torus(points: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
        away = points - knee
        return 1000 * (0.025 - torch.stack([away[..., [0, 2]].norm(dim=-1) - 0.06, away[..., 1]]).norm(dim=0))

    assert extract_template(torus, NO_POSE, field, cell=0.01).euler_characteristic == 0


def test_finer_cells_give_more_points(field: SkinningField) -> None:
    coarse, fine = (extract_template(ball, NO_POSE, field, cell=cell) for cell in (0.016, 0.008))
    assert 3 < len(fine.vertices) / len(coarse.vertices) < 5


def test_a_network_without_a_surface_is_refused(field: SkinningField) -> None:
    with pytest.raises(TrainingError, match="no surface"):
        extract_template(lambda points, pose: -torch.ones(points.shape[:2]), NO_POSE, field)


def test_the_plainest_pose_has_the_least_angles_but_for_the_root() -> None:
    rotations = np.ones((3, 24, 3))
    rotations[1, 0], rotations[1, 1:] = 9.0, 0.1
    conditions = pose_condition(rotations)
    assert conditions.shape == (3, 69) and torch.equal(plainest_pose(conditions), conditions[1])
    assert conditions[0, 0] == pytest.approx(1 / np.pi)


def test_a_stored_template_is_the_same(field: SkinningField, tmp_path: Path) -> None:
    made = extract_template(ball, NO_POSE, field)
    made.save(tmp_path / "template.safetensors")
    read = Template.load(tmp_path / "template.safetensors")
    assert all(torch.equal(value, getattr(read, name)) for name, value in vars(made).items())
    write_weights(tmp_path / "other.safetensors", {"layer": torch.ones(2)}, {})
    with pytest.raises(CheckpointError, match="no template, but layer"):
        Template.load(tmp_path / "other.safetensors")


def test_a_leg_is_learned_from_its_poses(field: SkinningField) -> None:
    torch.manual_seed(0)
    leg, random = posed_leg(), np.random.default_rng(0)
    frames = [
        frame_samples(random, [Mesh(posed, leg.body.faces)], body=leg.body, field=field, transforms=its, count=1000)
        for posed, its in zip(leg.posed, leg.transforms, strict=True)
    ]
    samples = FrameSamples(*map(torch.stack, zip(*frames, strict=True)))
    low, high = leg.body.vertices.min(0), leg.body.vertices.max(0)
    network = OccupancyTemplate(centre=((low + high) / 2).tolist(), radius=0.5, width=32)
    conditions = pose_condition(leg.poses.rotations)
    before, adam = near_surface_iou(network, samples, conditions), torch.optim.Adam(network.parameters(), 3e-3)
    for _ in range(150):
        some = torch.from_numpy(random.choice(1125, 300, replace=False))
        loss = template_loss(network, FrameSamples(*(each[:, some] for each in samples)), conditions, NO_HANDS)
        adam.zero_grad()
        loss.backward()
        adam.step()
    assert before < 0.6 and near_surface_iou(network, samples, conditions) > 0.8
    made = extract_template(network, plainest_pose(conditions), field)
    away = np.abs(Solid(leg.body.vertices, leg.body.faces).depth(made.vertices.numpy()))
    assert made.euler_characteristic == 2 and away.mean() < 0.025, "metres from the body"


@pytest.mark.parametrize("case", ["an edge", "a corner", "a cavity's corner", "a crumb", "a cavity", "random"])
def test_what_is_inside_becomes_one_piece_with_a_manifold_surface(case: str) -> None:
    values = np.full((9, 9, 9), 1.0)
    values[2:7, 2:7, 2:7] = -1
    if case == "an edge":
        values[2:4, 2:4] = values[4:7, 4:7] = 1
    elif case == "a corner":
        values[2:4, 2:4, 2:4] = -2
        values[4:7, 2:4, 2:4] = values[2:4, 4:7, 2:4] = 1
    elif case == "a cavity's corner":
        values[3, 3, 3] = values[2, 2, 2] = values[4, 4, 4] = 1
    elif case == "a crumb":
        values[1, 1, 1] = -1  # touches the block by a corner
    elif case == "a cavity":
        values[4, 4, 4] = 3
    else:
        values[2:7, 2:7, 2:7] = np.random.default_rng(0).normal(size=(5, 5, 5))
    made = one_piece(values)
    surface = trimesh.Trimesh(*surface_nets(made), process=False)
    assert surface.is_watertight and surface.body_count == 1
    for vertex, faces in enumerate(surface.vertex_faces):
        around = surface.faces[faces[faces >= 0]]
        ring = around[around != vertex].reshape(-1, 2)
        assert len(trimesh.graph.connected_components(ring)) == 1, "one fan of faces around every vertex"
    assert (np.abs(made) <= np.abs(values)).all() and (made[values < 0] < 0).mean() > 0.5
    assert (one_piece(made) == made).all()
