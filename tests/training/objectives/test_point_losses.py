"""The point avatar's loss against its formula over a table of all distances."""

import numpy as np
import pytest
import torch

from training.networks.avatar import Avatar
from training.objectives.point_losses import Edges, Scan, avatar_loss, nearest, squared_distances


def some(*counts: int, seed: int = 0) -> Avatar:
    """Frames of random points, all in need of a gradient."""
    torch.manual_seed(seed)
    total = sum(counts)
    values = [torch.randn(total, channels, dtype=torch.float64) for channels in (3, 3, 3, 3, 3, 5)]
    return Avatar(*(each.requires_grad_() for each in values), counts)  # type: ignore[arg-type]


def scans(*counts: int) -> list[Scan]:
    normalized = torch.nn.functional.normalize
    return [
        Scan(torch.randn(n, 3, dtype=torch.float64), normalized(torch.randn(n, 3, dtype=torch.float64), dim=1))
        for n in counts
    ]


def dense(avatar: Avatar, others: list[Scan], weight: float) -> torch.Tensor:
    """The formula, from all distances; frames one by one."""
    total, first = torch.zeros((), dtype=torch.float64), 0
    for count, (points, normals) in zip(avatar.counts, others, strict=True):
        own = [each[first : first + count] for each in avatar[:6]]
        first += count
        table = (own[0][:, None] - points).square().sum(-1)
        here = table.argmin(1)
        total = total + 1e4 * table.amin(0).mean()
        total = total + 1e4 * (normals[here] * (points[here] - own[0])).sum(1).square().mean()
        total = total + weight * (own[1] - normals[here]).abs().mean()
        total = total + 2000 * own[4].square().mean() + 400 * own[3].square().mean() + own[5].square().mean()
    return total / len(others)


def test_loss_and_gradient_are_those_of_all_distances() -> None:
    avatar, others = some(30, 50), scans(40, 20)
    loss, parts = avatar_loss(avatar, others, normals=0.7)
    wanted = dense(avatar, others, 0.7)
    torch.testing.assert_close(loss, wanted)
    leaves = [avatar.points, avatar.normals, avatar.corrections, avatar.displacements, avatar.features]
    for found, right in zip(torch.autograd.grad(loss, leaves), torch.autograd.grad(wanted, leaves), strict=True):
        torch.testing.assert_close(found, right)
    weights = {"reached": 1e4, "plane": 1e4, "normals": 0.7, "displacement": 2000, "correction": 400, "features": 1}
    torch.testing.assert_close(loss.detach(), sum(weights[name] * value for name, value in parts.items()))


def test_frames_count_alike_whatever_their_points() -> None:
    avatar, others = some(10, 90), scans(15, 60)
    both = avatar_loss(avatar, others, normals=1.0)[0]
    first, second = (
        avatar_loss(Avatar(*(each[rows] for each in avatar[:6]), (count,)), [scan], normals=1.0)[0]  # type: ignore[arg-type]
        for rows, count, scan in ((slice(10), 10, others[0]), (slice(10, None), 90, others[1]))
    )
    torch.testing.assert_close(both, (first + second) / 2)


def test_points_on_the_scan_with_its_normals_cost_nothing() -> None:
    (scan,), zeros = scans(25), torch.zeros(25, 3, dtype=torch.float64)
    avatar = Avatar(scan.points, scan.normals, zeros, zeros, zeros, zeros, (25,))
    assert avatar_loss(avatar, [scan], normals=1.0)[0] == 0


def test_a_point_that_is_not_finite_gives_a_loss_that_is_not() -> None:
    avatar = some(12)
    broken = avatar._replace(points=avatar.points.detach().index_fill(0, torch.tensor([3]), torch.nan))
    assert not avatar_loss(broken, scans(9), normals=1.0)[0].isfinite()


def test_the_nearest_of_all_distances_is_that_of_the_tree() -> None:
    """Which is how a GPU finds it, some queries at a time."""
    first, second = (torch.randn(count, 3, generator=torch.Generator().manual_seed(count)) for count in (50, 70))
    assert torch.equal(squared_distances(first, second).argmin(1), nearest(first, second))
    torch.testing.assert_close(squared_distances(first, second).sqrt(), torch.cdist(first, second))


@pytest.mark.gpu
def test_a_gpu_finds_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (torch.randn(count, 3, generator=torch.Generator().manual_seed(count)) for count in (50, 70))
    first[3] = torch.nan
    monkeypatch.setattr("training.objectives.point_losses._DISTANCES", 200)
    assert torch.equal(nearest(first.cuda(), second.cuda()).cpu(), nearest(first, second))


def test_the_nearest_is_that_of_a_table() -> None:
    first, second = torch.randn(40, 3), torch.randn(70, 3)
    assert torch.equal(nearest(first, second), torch.cdist(first, second).argmin(1))


def test_roughness_is_how_far_offsets_are_from_those_around() -> None:
    """One point of a square pyramid off by 3 cm: itself by all of it, a corner of the base by a third."""
    edges = Edges.of(np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]), 6)
    zeros = torch.zeros(6, 3, dtype=torch.float64)
    tip = zeros.index_fill(0, torch.tensor([4]), 0.03 / 3**0.5)
    (scan,) = scans(9)
    for offset, wanted in ((tip, (0.03 + 4 * 0.01) / 6), (zeros, 0.0)):
        avatar = Avatar(offset, zeros, zeros, zeros, zeros, zeros, (6,))
        rough, plain = (avatar_loss(avatar, [scan], normals=1.0, edges=own, roughness=70) for own in ([edges], []))
        assert rough[1]["roughness"].item() == pytest.approx(wanted)
        assert (rough[0] - plain[0]).item() == pytest.approx(70 * wanted)


def test_offsets_of_none_have_a_gradient() -> None:
    avatar = some(5)
    still = avatar._replace(points=avatar.skinned + 0 * avatar.displacements)
    loss = avatar_loss(
        still, scans(9), normals=1.0, edges=[Edges.of(np.array([[0, 1, 2], [2, 3, 4]]), 5)], roughness=1.0
    )[0]
    assert torch.autograd.grad(loss, avatar.displacements)[0].isfinite().all()


def test_frames_without_a_scan_are_refused() -> None:
    with pytest.raises(ValueError, match="2 frames were given 1 scans"):
        avatar_loss(some(3, 3), scans(4), normals=1.0)
