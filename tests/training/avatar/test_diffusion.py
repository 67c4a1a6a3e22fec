"""The field has the body's weights on the skin, hardly changes along its normals, and keeps them when it is stored."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from datagen.common.errors import CheckpointError
from datagen.mesh.geometry import vertex_normals
from tests.support.shapes.canonical import posed_leg
from training.avatar.diffusion import SkinningField, ThinPlate, diffused_skinning, farthest_points, thin_plate
from training.checkpoints.weights import write_weights


@pytest.fixture(scope="module")
def plate() -> ThinPlate:
    return thin_plate(posed_leg().body, centres=200)


@pytest.fixture(scope="module")
def field() -> SkinningField:
    return diffused_skinning(posed_leg().body, centres=200, spacing=0.02)


def test_the_spline_goes_through_the_weights_of_its_centres(plate: ThinPlate) -> None:
    body = posed_leg().body
    away, vertex = torch.cdist(torch.from_numpy(plate.centres), torch.from_numpy(body.vertices)).min(dim=1)
    assert (away < 1e-6).sum() == 200 and (away > 0.005).sum() > 150, "vertices, then their companions off the skin"
    assert np.abs(plate.weights(plate.centres) - body.weights[vertex.numpy()]).max() < 1e-4


def test_weights_are_shares(plate: ThinPlate, field: SkinningField) -> None:
    anywhere = np.random.default_rng(0).uniform(-2, 2, (5000, 3))
    for weights in (plate.weights(anywhere), field.weights(torch.from_numpy(anywhere).float()).numpy()):
        assert weights.min() >= 0 and weights.sum(axis=1) == pytest.approx(np.ones(5000), abs=1e-5)


def test_weights_change_along_the_skin_rather_than_across_it(plate: ThinPlate) -> None:
    body = posed_leg().body
    normals = vertex_normals(body.vertices, body.faces)
    blended = (body.weights.max(axis=1) < 0.9) & (np.abs(normals[:, 1]) < 0.3)
    points, out, along = body.vertices[blended] + 0.004 * normals[blended], normals[blended], body.joints[1]
    across = np.abs(plate.weights(points + 0.002 * out) - plate.weights(points - 0.002 * out))
    down = 0.002 * along / np.linalg.norm(along)
    assert across.mean() < 0.5 * np.abs(plate.weights(points + down) - plate.weights(points - down)).mean()


def test_the_grid_is_the_spline_between_its_cells(plate: ThinPlate, field: SkinningField) -> None:
    cells = field.cells().reshape(-1, 3)
    assert np.abs(field.weights(cells.float()).numpy() - plate.weights(cells.numpy())).max() < 1e-3
    skin = torch.from_numpy(posed_leg().body.vertices)
    assert np.abs(field.weights(skin.float()).numpy() - plate.weights(skin.numpy())).mean() < 0.01


def test_what_is_within_a_cavity_has_no_say() -> None:
    body, ball = posed_leg().body, trimesh.creation.icosphere(2, 0.03)
    centre = body.joints[0] + 0.3 * (body.joints[1] - body.joints[0])
    cavity = replace(
        body,
        vertices=np.concatenate([body.vertices, ball.vertices + centre]),
        faces=np.concatenate([body.faces, ball.faces[:, ::-1] + len(body.vertices)]),
        weights=np.concatenate([body.weights, np.tile([0.0, 1.0], (len(ball.vertices), 1))]),
    )
    assert thin_plate(cavity, centres=300).weights(centre[None])[0, 0] > 0.9


def test_farthest_points_are_distinct_and_spread() -> None:
    line = np.zeros((102, 3))
    line[:101, 0], line[101] = np.arange(101), line[50]
    assert sorted(farthest_points(line, 3).tolist()) == [0, 50, 100]
    assert len(farthest_points(line, 500)) == 101, "one of two at the same place"


def test_a_stored_field_is_the_same(field: SkinningField, tmp_path: Path) -> None:
    field.save(tmp_path / "field.safetensors")
    points = torch.rand(100, 3) - 0.5
    assert torch.equal(SkinningField.load(tmp_path / "field.safetensors").weights(points), field.weights(points))
    write_weights(tmp_path / "other.safetensors", {"layer": torch.ones(2)}, {})
    with pytest.raises(CheckpointError, match="no skinning field, but layer"):
        SkinningField.load(tmp_path / "other.safetensors")
    replace(field, grid=field.grid[0]).save(tmp_path / "flat.safetensors")
    with pytest.raises(CheckpointError, match="no skinning field, but a grid of 3 axes"):
        SkinningField.load(tmp_path / "flat.safetensors")


def test_progress_goes_through_all_points(plate: ThinPlate) -> None:
    told = list[int]()
    plate.weights(np.zeros((9000, 3)), progress=lambda firsts: (told.append(first) or first for first in firsts))
    assert told == [0, 4000, 8000]
