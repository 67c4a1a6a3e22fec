"""Position maps against the plain way to draw them: every pixel asks every triangle."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from datagen.mesh.geometry import Mesh
from tests.support.shapes.avatars import bent, sphere, weights_of
from training.avatar.maps import PositionMaps, Views, colored, drawn_vertices, root_free
from training.networks.avatar import blend, moved, read_maps

BALL = sphere()
VIEWS = Views.of([BALL.vertices])


def asked(views: Views, mesh: Mesh, colors: np.ndarray, size: int) -> np.ndarray:
    """Pictures [view, size, size, 3]: at each pixel's middle, the nearest triangle's colour; zero where is none."""
    middles = (np.arange(size) + 0.5) * 2 / size - 1
    x, y = np.meshgrid(middles, -middles)
    pictures = []
    for place in views.places(mesh.vertices):
        a, b, c = (place[mesh.faces[:, corner]] for corner in range(3))
        whole = crossed(b - a, c - a)
        away = np.stack([x, y], axis=-1)[:, :, None] - a[:, :2]
        second, third = crossed(away, c - a) / whole, crossed(b - a, away) / whole
        shares = np.stack([1 - second - third, second, third], axis=-1)
        towards = (shares * np.stack([a, b, c], axis=1)[..., 2]).sum(-1)
        nearest = np.where((shares >= 0).all(-1), towards, -np.inf).argmax(-1)[..., None]
        hit = (np.take_along_axis(shares.min(-1), nearest, 2) >= 0)[..., 0]
        own = np.take_along_axis(shares, nearest[..., None], 2)[:, :, 0]
        pictures.append(np.where(hit[..., None], (own[..., None] * colors[mesh.faces[nearest[..., 0]]]).sum(-2), 0))
    return np.stack(pictures)


def crossed(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]


def test_a_map_is_the_posed_colours_drawn() -> None:
    transforms, weights = torch.from_numpy(bent(50)[None]).float(), weights_of(BALL)
    posed = moved(blend(weights, transforms), torch.from_numpy(BALL.vertices).float())[0]
    found = PositionMaps(VIEWS, BALL, weights, size=32)(transforms)[0].permute(0, 2, 3, 1)
    wanted = asked(VIEWS, BALL, posed.numpy(), 32)
    assert np.abs(found.numpy() - wanted).max() < 1e-6
    assert 0.4 < (wanted != 0).any(-1).mean() < 0.8


def test_what_is_in_front_covers_what_is_behind() -> None:
    inner = sphere(radius=0.3)
    both = Mesh(np.concatenate([BALL.vertices, inner.vertices]), np.concatenate([BALL.faces, inner.faces + 162]))
    color = torch.cat([torch.ones(162, 1), 2 * torch.ones(162, 1)])[None]
    found = colored(drawn_vertices(VIEWS, both, 32).float(), color, 32)
    assert torch.unique(found.round(decimals=5)).tolist() == [0, 1]


def test_visible_points_read_where_they_went_within_a_pixel() -> None:
    size, transforms, weights = 64, torch.from_numpy(bent(40)[None]).float(), weights_of(BALL)
    maps = PositionMaps(VIEWS, BALL, weights, size=size)(transforms)[0]
    places = VIEWS.places(BALL.vertices)
    read = read_maps(maps, torch.from_numpy(places[..., :2]).float()).reshape(-1, 4, 3).numpy()
    posed = moved(blend(weights, transforms), torch.from_numpy(BALL.vertices).float())[0].numpy()
    for view in range(4):
        facing = places[view, :, 2] > 0.3 * places[view, :, 2].max()
        assert facing.sum() > 40
        assert np.linalg.norm(read[facing, view] - posed[facing], axis=1).max() < 2 / (VIEWS.scale * size)


def test_the_first_view_is_from_the_right_in_front_and_above() -> None:
    right_front_above = np.array([[-np.sin(np.pi / 4), 0, np.cos(np.pi / 4)]]) * np.cos(np.pi / 6) + [[0, 0.5, 0]]
    assert Views(np.zeros((4, 2)), 1.0).places(right_front_above)[0].round(9).tolist() == [[0, 0, 1]]


def test_all_templates_fit_into_every_view_with_room() -> None:
    tall = BALL.vertices * [0.2, 3, 0.2] + [0, 1, 0]
    views = Views.of([BALL.vertices, tall])
    reach = np.abs(np.concatenate([views.places(each) for each in (BALL.vertices, tall)], axis=1)[..., :2])
    assert np.isclose(reach.max(), 1 / 1.05)
    assert reach.max(axis=(1, 2)).min() > 0.8


def test_a_map_does_not_tell_where_the_root_is() -> None:
    transforms, weights = torch.from_numpy(bent(50)[None]).float(), weights_of(BALL)
    turn = torch.from_numpy(Rotation.from_rotvec([0.3, 2, 0.4]).as_matrix()).float()
    elsewhere = turn @ transforms + torch.tensor([0, 0, 0, 1.0]) * torch.tensor([[0.5], [2], [3]])
    still = root_free(elsewhere)
    torch.testing.assert_close(still[0, 0], torch.eye(3, 4), atol=1e-6, rtol=0)
    maps = PositionMaps(VIEWS, BALL, weights, size=16)
    torch.testing.assert_close(maps(elsewhere), maps(transforms), atol=2e-6, rtol=0)
