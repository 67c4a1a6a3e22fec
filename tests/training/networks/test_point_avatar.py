"""The point avatar: its parameters, exact skinning where it changes nothing, and frames that do not know each other."""

import numpy as np
import pytest
import torch

from datagen.mesh.rig import skinned
from tests.support.shapes.avatars import SIZES, avatar, bent, sphere, template_of
from training.avatar.maps import PositionMaps, Views
from training.networks.avatar import Avatar, CanonicalPoints, PointAvatar, read_maps
from training.objectives.point_losses import Scan, avatar_loss
from training.recipes.networks import AvatarRecipe

BALL, SMALL = sphere(), sphere(radius=0.3, subdivisions=1)


def frames(*degrees: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Transforms of some poses, and maps of noise that differ."""
    transforms = torch.from_numpy(np.stack([bent(each, shift=each / 90) for each in degrees])).float()
    size = SIZES["map_size"]
    noise = [torch.randn(4, 3, size, size, generator=torch.Generator().manual_seed(int(each))) for each in degrees]
    return torch.stack(noise), transforms


@pytest.mark.parametrize("normalisation", ["group", "batch"])
def test_it_has_the_released_parameters_without_those_that_are_never_called(normalisation: str) -> None:
    recipe = AvatarRecipe(normalisation=normalisation)  # type: ignore[arg-type]
    network = PointAvatar([template_of(SMALL)], **recipe.sizes())
    own = network.features.numel()
    assert own == 42 * 64
    assert sum(each.numel() for each in network.parameters()) - own == 10_405_120 - 4 * 262_144 + 599_814 + 13_059


def test_without_correction_and_displacement_it_is_template_skinning() -> None:
    network, (maps, transforms) = avatar(BALL), frames(30)
    for layer in (network.correction[-1], network.decoder.displacement[-1], network.decoder.turn[-1]):
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    found = network(maps, transforms, [0])
    assert torch.equal(found.points, found.skinned)
    exact = skinned(BALL.vertices, network.weights.numpy(), transforms.numpy())[0]
    assert np.abs(found.points.detach().numpy() - exact).max() < 1e-6
    still = network(maps, frames(0)[1], [0])
    torch.testing.assert_close(still.normals, network.normals)


def test_corrections_are_skinned_and_displacements_are_in_the_pose() -> None:
    network, (maps, transforms) = avatar(BALL), frames(40)
    found = network(maps, transforms, [0])
    corrected = skinned(
        BALL.vertices + found.corrections.detach().numpy(), network.weights.numpy(), transforms.numpy()
    )[0]
    assert np.abs((found.points - found.displacements).detach().numpy() - corrected).max() < 1e-6
    assert found.displacements.abs().max() > 1e-4
    torch.testing.assert_close(found.normals.norm(dim=1), torch.ones(162))


def test_points_in_another_order_come_out_in_that_order() -> None:
    network, order = avatar(BALL), torch.randperm(162, generator=torch.Generator().manual_seed(1))
    points, normals, weights, places = template_of(BALL)
    again = PointAvatar([CanonicalPoints(points[order], normals[order], weights[order], places[:, order])], **SIZES)
    own = {"points", "normals", "weights", "places", "features"}
    again.load_state_dict({k: v for k, v in network.state_dict().items() if k not in own}, strict=False)
    again.features.data = network.features.data[order]
    first, second = (each(*frames(20), [0]) for each in (network, again))
    torch.testing.assert_close(second.points, first.points[order])
    torch.testing.assert_close(second.normals, first.normals[order])


def test_frames_of_several_outfits_are_as_each_alone() -> None:
    network, (maps, transforms) = avatar(BALL, SMALL), frames(10, 20, 30)
    together = network(maps, transforms, [1, 0, 1])
    assert together.counts == (42, 162, 42)
    alone = [network(maps[[row]], transforms[[row]], [outfit]) for row, outfit in enumerate((1, 0, 1))]
    for name in ("points", "normals", "corrections"):
        torch.testing.assert_close(getattr(together, name), torch.cat([getattr(each, name) for each in alone]))
    assert not torch.allclose(alone[0].points, alone[2].points)


@pytest.mark.parametrize("normalisation", ["group", "batch"])
def test_every_parameter_has_a_gradient_though_an_outfit_is_not_in_the_batch(normalisation: str) -> None:
    network = avatar(BALL, SMALL, normalisation=normalisation)
    found = network(*frames(10, 20), [1, 1])
    avatar_loss(found, [Scan(torch.rand(50, 3), torch.rand(50, 3))] * 2, normals=1.0)[0].backward()
    missing = [name for name, each in network.named_parameters() if each.grad is None]
    assert not missing
    assert network.features.grad is not None and not network.features.grad[:162].any()


def test_weights_are_read_back_with_the_templates_they_are_of() -> None:
    network, again = avatar(BALL, SMALL), avatar(BALL, SMALL, seed=1)
    again.load_state_dict(network.state_dict())
    for outfit in (0, 1):
        assert torch.equal(network(*frames(20), [outfit]).points, again(*frames(20), [outfit]).points)


def test_maps_are_read_to_the_right_and_up_and_are_zero_outside() -> None:
    maps = torch.arange(16.0).reshape(1, 1, 4, 4)
    places = torch.tensor([[[-0.75, 0.75], [0.75, 0.75], [-0.75, -0.75], [-0.5, 0.75], [3.0, 0.0]]])
    assert read_maps(maps, places)[:, 0].tolist() == [0, 3, 12, 0.5, 0]


def test_it_learns_one_frame_to_a_millimetre_and_a_half() -> None:
    """A bent sphere with waves on it of 4 cm, from a template without: the distance to the scan's planes."""
    ball = sphere(radius=0.3, subdivisions=3)
    network, transforms = avatar(ball), torch.from_numpy(bent(30)[None]).float()
    maps = PositionMaps(Views.of([ball.vertices]), ball, network.weights, size=SIZES["map_size"])(transforms)
    scan = _waves(network, maps, transforms)
    optimizer = torch.optim.Adam(network.parameters(), lr=4e-3)
    first = _apart(network(maps, transforms, [0]), scan)
    for _ in range(150):
        optimizer.zero_grad()
        avatar_loss(network(maps, transforms, [0]), [scan], normals=1e-6)[0].backward()
        optimizer.step()
    assert first > 5
    assert _apart(network(maps, transforms, [0]), scan) < 1.5


def _waves(network: PointAvatar, maps: torch.Tensor, transforms: torch.Tensor) -> Scan:
    with torch.no_grad():
        posed = network(maps, transforms, [0]).skinned
    points = (posed + 0.02 * torch.sin(12 * posed[:, [1]]) * network.normals).numpy()
    import trimesh

    its = trimesh.Trimesh(points, sphere(radius=0.3, subdivisions=3).faces, process=False)
    return Scan(torch.from_numpy(points), torch.from_numpy(np.array(its.vertex_normals)).float())


@torch.no_grad()
def _apart(found: Avatar, scan: Scan) -> float:
    there = torch.cdist(found.points, scan.points).argmin(dim=1)
    return 1000 * float(((scan.points[there] - found.points) * scan.normals[there]).sum(dim=1).abs().mean())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pose": 6}, "multiple of 4"),
        ({"map_size": 24}, "power of two of at least 16, got 24"),
        ({"normalisation": "layer"}, "'group' or 'batch', got 'layer'"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PointAvatar([template_of(SMALL)], **{**SIZES, **options})  # type: ignore[arg-type]


def test_templates_that_do_not_fit_are_refused() -> None:
    small = template_of(SMALL)
    with pytest.raises(ValueError, match="there is none"):
        PointAvatar([])
    with pytest.raises(ValueError, match=r"template 1: weights must be \[42, 2\], got \[42, 1\]"):
        PointAvatar([small, small._replace(weights=torch.ones(42, 1))])
