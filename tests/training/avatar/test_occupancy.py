"""Points around scans: where they are drawn, what is inside, and where they come from."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from datagen.mesh.geometry import Mesh
from tests.support.shapes.canonical import posed_leg
from training.avatar.diffusion import diffused_skinning
from training.avatar.occupancy import FrameSamples, frame_samples, hand_samples, inside_any, surface_points
from training.avatar.roots import TransformField
from training.avatar.solid import Solid


def ball(radius: float, x: float = 0.0) -> Mesh:
    made = trimesh.creation.icosphere(3, radius)
    return Mesh(made.vertices + np.array([x, 0, 0]), made.faces)


def test_inside_is_inside_of_any_part() -> None:
    points = np.array([[0, 0, 0], [3, 0, 0], [1.5, 0, 0.0]])
    assert inside_any([ball(1), ball(1, 3)], points).tolist() == [True, True, False]


def test_surface_points_are_uniform_by_area_and_leave_out_what_other_parts_hide() -> None:
    points, normals = surface_points(np.random.default_rng(0), [ball(1), ball(0.5), ball(1, 3)], 9000)
    radius = np.linalg.norm(points - np.round(points[:, :1] / 3) * [[3, 0, 0]], axis=1)
    assert radius == pytest.approx(np.ones(len(points)), abs=0.02), "none of the ball within the first"
    assert len(points) == pytest.approx(9000 * 8 / 9, rel=0.02)
    assert (points[:, 0] > 1.5).mean() == pytest.approx(0.5, abs=0.03)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(len(points)))
    assert (normals * (points - np.round(points[:, :1] / 3) * [[3, 0, 0]])).sum(axis=1).min() > 0.98


@pytest.fixture(scope="module")
def samples() -> FrameSamples:
    leg = posed_leg()
    field = diffused_skinning(leg.body, centres=200)
    scan = [Mesh(leg.posed[1], leg.body.faces)]
    drawn = np.random.default_rng(0)
    return frame_samples(drawn, scan, body=leg.body, field=field, transforms=leg.transforms[1], count=800)


def test_samples_lie_near_the_surface_and_a_ninth_anywhere_in_the_box(samples: FrameSamples) -> None:
    assert samples.roots.shape == (900, 3, 3) and samples.near.sum() == 800
    assert 0.35 < samples.inside[samples.near].float().mean() < 0.65, "as many on either side of the skin"
    leg, free = posed_leg(), samples.valid[:, 0] & ~samples.near
    field, places = diffused_skinning(leg.body, centres=200), samples.roots[free, 0]
    reached = (torch.stack([places.amin(0), places.amax(0)]) - field.low) / (field.high - field.low)
    assert reached[0].max() < 0.1 and reached[1].min() > 0.9 and free.sum() > 60
    posed = TransformField.of(field, torch.from_numpy(leg.transforms[1]).float()).posed(places)
    assert Solid(leg.posed[1], leg.body.faces).depth(posed.numpy()).max() < -0.025
    assert not samples.inside[~samples.near].any() and not samples.valid[~samples.near, 1:].any()


def test_what_is_inside_of_the_scan_is_inside_of_the_canonical_body(samples: FrameSamples) -> None:
    solid = Solid(posed_leg().body.vertices, posed_leg().body.faces)
    found = samples.valid[:, 0]
    assert found[samples.near].float().mean() > 0.9
    canonical = torch.from_numpy(solid.inside(samples.roots[found, 0].numpy()))
    assert (canonical == samples.inside[found]).float().mean() > 0.95


def test_places_on_hands_do_not_count_and_the_body_speaks_for_them(samples: FrameSamples) -> None:
    leg = posed_leg()
    assert len(hand_samples(np.random.default_rng(0), leg.body, 50)[0]) == 0
    handy = replace(leg.body, drivers=("left_hip", "left_wrist"))
    points, inside = hand_samples(np.random.default_rng(0), handy, 400)
    assert len(points) == 400 and 0.3 < inside.float().mean() < 0.7
    solid, knee = Solid(handy.vertices, handy.faces), handy.joints[1, 1]
    fine, wide = (np.abs(solid.depth(points[half::2].numpy())) for half in (0, 1))
    assert fine.max() < 0.03 < wide.max() < 0.15 and points[:, 1].max() < knee + 0.1
    field, drawn = diffused_skinning(handy, centres=200), np.random.default_rng(0)
    scan = [Mesh(leg.posed[1], leg.body.faces)]
    without = frame_samples(drawn, scan, body=handy, field=field, transforms=leg.transforms[1], count=800)
    lost = samples.valid[:, 0] & ~without.valid[:, 0]
    assert lost.any() and samples.roots[lost, 0, 1].max() < knee + 0.1 and without.valid.any()
