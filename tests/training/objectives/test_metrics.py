"""Metrics in cases known by analysis and on real bodies: brute force in float64, bounds, memory, what is not finite."""

from __future__ import annotations

import itertools
import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from datagen.bodies import load_body
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import bounding_box, edges_of
from datagen.poses import draw_poses
from datagen.recipe import AnnyBody, AnnyTopology, PoseRecipe
from training.objectives import metrics

Body = tuple[NDArray[np.float64], NDArray[np.int32]]
TOPOLOGIES: tuple[AnnyTopology, ...] = ("notoes_collapse3pc", "notoes_collapse5pc")


@pytest.fixture(scope="module")
def bodies() -> list[Body]:
    """Two identities in three poses, normalised [mesh, vertex, 3], and faces, of two topologies."""
    found = []
    for topology in TOPOLOGIES:
        body, poses = load_body(AnnyBody(topology=topology)), draw_poses(PoseRecipe(), range(3))
        drawn = [body.draw_identity(generator(0, Stream.IDENTITY, number), number) for number in range(2)]
        meshes = np.concatenate([body.vertices(parameters, poses) for parameters in drawn]).astype(np.float64)
        found.append((np.stack([bounding_box(mesh).normalise(mesh) for mesh in meshes]), body.faces(drawn[0])))
    return found


def by_hand(ours: NDArray[np.float64], right: NDArray[np.float64], faces: NDArray[np.int32]) -> dict[str, float]:
    """All metrics of one pair by plain loops and whole matrices, from their definitions."""
    table = np.sqrt(((ours[:, None] - right[None]) ** 2).sum(2))
    rows, columns = linear_sum_assignment(table)
    middle = (ours.min(0) + ours.max(0) - right.min(0) - right.max(0)) / 2
    pairs = {tuple(sorted(pair)) for a, b, c in faces.tolist() for pair in ((a, b), (b, c), (c, a))}
    ratios = [abs(math.dist(ours[i], ours[j]) / math.dist(right[i], right[j]) - 1) for i, j in pairs]
    normals = [[np.cross(m[b] - m[a], m[c] - m[a]) for a, b, c in faces.tolist()] for m in (ours, right)]
    cosines = [p @ t / np.linalg.norm(p) / np.linalg.norm(t) for p, t in zip(*normals, strict=True)]
    return {
        "pmd": float(((ours - right) ** 2).sum()) / ours.size,
        "recentred": float(((ours - middle - right) ** 2).sum()) / ours.size,
        "euclidean": float(np.mean([math.dist(p, t) for p, t in zip(ours, right, strict=True)])),
        "chamfer": float((table.min(0) ** 2).mean() + (table.min(1) ** 2).mean()),
        "earth_mover": float(table[rows, columns].mean()),
        "edges": float(np.mean(ratios)),
        "normals": float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean()),
    }


def measured(ours: Tensor, right: Tensor, faces: NDArray[np.int32]) -> dict[str, Tensor]:
    return {
        "pmd": metrics.point_mesh_distance(ours, right),
        "recentred": metrics.recentred_point_mesh_distance(ours, right),
        "euclidean": metrics.mean_euclidean_error(ours, right),
        "chamfer": metrics.chamfer_distance(ours, right),
        "earth_mover": metrics.earth_mover_distance(ours, right),
        "edges": metrics.edge_length_ratio_error(ours, right, torch.from_numpy(edges_of(faces))),
        "normals": metrics.normal_angle_error(ours, right, torch.from_numpy(faces)),
    }


def batch(*meshes: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(np.stack(meshes))


def _random(batch: int, vertices: int, seed: int) -> Tensor:
    return torch.randn(batch, vertices, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


pairs = st.tuples(st.integers(1, 3), st.integers(1, 12), st.integers(0, 10**6), st.floats(0, 3)).map(
    lambda case: (_random(*case[:3]), _random(*case[:3]) + case[3] * _random(case[0], case[1], case[2] + 1))
)


def test_point_mesh_distance_is_a_mean_over_coordinates_too() -> None:
    truth = torch.zeros(2, 5, 3)
    prediction = truth.clone()
    prediction[1] += torch.tensor([1.0, 2.0, 2.0])
    found = metrics.point_mesh_distance(prediction, truth)
    assert found.dtype == torch.float64
    assert found.tolist() == pytest.approx([0.0, 3.0])
    assert metrics.mean_euclidean_error(prediction, truth).tolist() == pytest.approx([0.0, 3.0])


def test_recentred_distance_ignores_a_shift_and_uses_the_box_not_the_mean() -> None:
    truth = _random(2, 9, 0)
    assert metrics.recentred_point_mesh_distance(truth + 5, truth).tolist() == pytest.approx([0, 0], abs=1e-20)
    prediction = torch.tensor([[[0.0, 0, 0], [0, 0, 0], [2, 0, 0]]])
    other = torch.tensor([[[10.0, 0, 0], [12, 0, 0], [12, 0, 0]]])
    assert metrics.recentred_point_mesh_distance(prediction, other).tolist() == pytest.approx([4 / 9])


def test_distance_by_area_weighs_a_vertex_by_its_faces_however_they_are_split() -> None:
    square = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [9, 9, 9]])[None]
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    moved = square + torch.tensor([[3.0], [0], [0], [0], [100]]) * torch.tensor([0.0, 0, 1])
    assert metrics.area_point_mesh_distance(moved, square, faces).item() == pytest.approx(3 * 1 / 3)  # a third of both
    fine = torch.cat([square, torch.full((1, 1, 3), 1.0) * torch.tensor([1.0, 1, 0])], dim=1)  # its middle, all at rest
    split = torch.tensor([[0, 1, 5], [1, 2, 5], [2, 3, 5], [3, 0, 5]])
    lifted = torch.cat([moved, fine[:, 5:]], dim=1)
    assert metrics.area_point_mesh_distance(lifted, fine, split).item() == pytest.approx(3 / 6)
    assert math.isnan(metrics.area_point_mesh_distance(square * 0, square * 0, faces).item())
    even = metrics.area_point_mesh_distance(square[:, :4] + 1, square[:, :4], faces)
    assert even.item() == pytest.approx(metrics.point_mesh_distance(square + 1, square).item())


def test_earth_mover_distance_equals_the_best_of_all_permutations() -> None:
    first, second = _random(3, 6, 0), _random(3, 6, 1)
    for value, p, t in zip(metrics.earth_mover_distance(first, second), first, second, strict=True):
        costs = (p[:, None] - t[None]).norm(dim=2)
        orders = itertools.permutations(range(6))
        best = min(costs[torch.arange(6), torch.tensor(order)].mean().item() for order in orders)
        assert value.item() == pytest.approx(best, rel=1e-12)


def test_earth_mover_distance_draws_the_same_vertices_of_both_by_the_seed() -> None:
    truth = _random(2, 300, 0)
    assert metrics.earth_mover_distance(truth, truth, points=50).tolist() == [0, 0]
    # A small common shift moves every chosen vertex by its length, provided that the same ones are chosen.
    shifted = metrics.earth_mover_distance(truth + 1e-3, truth, points=50)
    assert shifted.tolist() == pytest.approx([1e-3 * math.sqrt(3)] * 2, rel=1e-9)
    other = _random(2, 300, 1)
    first, again, different = (metrics.earth_mover_distance(other, truth, points=50, seed=s) for s in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, different)


def test_edge_length_ratio_error_in_known_cases() -> None:
    truth = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 2, 0]]])
    edges = torch.tensor([[0, 1], [0, 2], [2, 3]])  # the last has length zero in the truth
    prediction = truth * torch.tensor([1.5, 1.0, 1.0])
    assert metrics.edge_length_ratio_error(prediction, truth, edges).tolist() == pytest.approx([0.5 / 3])


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 30.0, 90.0, 180.0])
def test_normal_angle_error_of_a_rotation_is_its_angle(degrees: float) -> None:
    truth = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [7, 7, 0]]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]], dtype=torch.int32)
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    rotation = torch.tensor([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]], dtype=torch.float64)
    found = metrics.normal_angle_error(truth @ rotation.t(), truth, faces)
    assert found.tolist() == pytest.approx([degrees], rel=1e-6, abs=1e-9)


def test_normal_angle_error_counts_faces_once_and_treats_flat_ones_as_documented() -> None:
    truth = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 9], [2, 0, 0]]])
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 1, 4]])  # the last has no area in the truth: left out
    flipped = truth * torch.tensor([1.0, -1.0, 1.0])  # turns the first normal round and keeps the second
    assert metrics.normal_angle_error(flipped, truth, faces).tolist() == pytest.approx([90.0])
    collapsed = torch.zeros_like(truth)
    assert metrics.normal_angle_error(collapsed, truth, faces).tolist() == pytest.approx([90.0])
    assert metrics.normal_angle_error(truth, collapsed, faces).tolist() == [0.0]


@settings(max_examples=60)
@given(pairs, st.integers(1, 12), st.integers(0, 99))
def test_bounds_between_metrics(pair: tuple[Tensor, Tensor], points: int, seed: int) -> None:
    """That of the earth mover's distance also over some of the vertices, the same of both."""
    prediction, truth = pair
    count, distance = truth.shape[1], metrics.point_mesh_distance(prediction, truth)
    chosen = np.random.default_rng(seed).permutation(count)[:points] if points < count else np.arange(count)
    slack = 1e-12
    assert (metrics.earth_mover_distance(prediction, truth) <= (3 * distance).sqrt() + slack).all()
    among = metrics.point_mesh_distance(prediction[:, chosen], truth[:, chosen])
    found = metrics.earth_mover_distance(prediction, truth, points=points, seed=seed)
    assert (found <= (3 * among).sqrt() + slack).all()
    assert (metrics.chamfer_distance(prediction, truth) <= 6 * distance + slack).all()
    assert (metrics.mean_euclidean_error(prediction, truth) <= (3 * distance).sqrt() + slack).all()


@settings(max_examples=30)
@given(pairs, st.integers(0, 10**6))
def test_set_metrics_ignore_the_order_of_vertices_and_are_symmetric(pair: tuple[Tensor, Tensor], seed: int) -> None:
    prediction, truth = pair
    order = torch.randperm(truth.shape[1], generator=torch.Generator().manual_seed(seed))
    for metric in (metrics.chamfer_distance, metrics.earth_mover_distance):
        value = metric(prediction, truth)
        torch.testing.assert_close(metric(prediction[:, order], truth), value, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(metric(truth, prediction), value, rtol=1e-10, atol=1e-12)


def test_errors_carry_the_shapes() -> None:
    with pytest.raises(ValueError, match=r"\[2, 5, 3\] and \[2, 4, 3\]"):
        metrics.point_mesh_distance(_random(2, 5, 0), _random(2, 4, 0))
    with pytest.raises(ValueError, match=r"\[2, 5, 3\] and \[1, 5, 3\]"):
        metrics.chamfer_distance(_random(2, 5, 0), _random(1, 5, 0))
    with pytest.raises(ValueError, match=r"\[batch, vertex, 3\].*got \[5, 3\]"):
        metrics.point_mesh_distance(_random(2, 5, 0)[0], _random(2, 5, 0)[0])
    with pytest.raises(ValueError, match="points must be positive, got 0"):
        metrics.earth_mover_distance(_random(2, 5, 0), _random(2, 5, 0), points=0)


@settings(max_examples=8)
@given(
    kind=st.integers(0, 1),
    pair=st.tuples(st.integers(0, 5), st.integers(0, 5)),
    noise=st.sampled_from([0.0, 1e-3, 0.1]),
    scale=st.sampled_from([1.0, 1e-3, 1e3]),
    seed=st.integers(0, 99),
)
def test_any_pair_of_real_meshes_agrees_with_brute_force(
    bodies: list[Body], kind: int, pair: tuple[int, int], noise: float, scale: float, seed: int
) -> None:
    meshes, faces = bodies[kind]
    disturbed = meshes[pair[0]] + noise * np.random.default_rng(seed).normal(size=meshes[0].shape)
    # float32 as a network gives it: metrics of these very numbers are wanted, not of others nearby
    ours, right = (scale * mesh.astype(np.float32) for mesh in (disturbed, meshes[pair[1]]))
    found = measured(batch(ours, right), batch(right, right), faces)
    expected = by_hand(ours.astype(np.float64), right.astype(np.float64), faces)
    for name, value in expected.items():
        # the oracle's arc cosine is good to 1e-6 degrees only near zero
        assert found[name][0].item() == pytest.approx(value, rel=1e-6, abs=3e-6 if name == "normals" else 1e-12), name
        assert found[name][1].item() == pytest.approx(0, abs=1e-9), "a mesh is no distance from itself"


def test_chamfer_between_two_topologies_agrees_with_brute_force(bodies: list[Body]) -> None:
    (few, _), (many, _) = bodies
    found = metrics.chamfer_distance(torch.from_numpy(few), torch.from_numpy(many))
    for value, p, t in zip(found.tolist(), few, many, strict=True):
        table = ((p[:, None] - t[None]) ** 2).sum(2)
        assert value == pytest.approx(table.min(0).mean() + table.min(1).mean(), rel=1e-9)


@pytest.mark.parametrize("case", ["collapsed", "apart", "doubled", "line", "cube", "one", "two"])
def test_assignments_are_the_best_where_prices_help_least(case: str) -> None:
    random = np.random.default_rng(5)
    ours, right = random.normal(size=(2, 90, 3))
    if case == "collapsed":
        ours = np.repeat(ours[:1], 90, axis=0)
    elif case == "apart":
        right[:45] += 1e6
    elif case == "doubled":
        ours, right = np.repeat(ours[:45], 2, axis=0), np.repeat(right[:30], 3, axis=0)
    elif case == "line":
        ours[:, 1:], right[:, 1:] = 0, 0
    elif case == "cube":  # many assignments of the same cost
        ours = right = np.stack(np.meshgrid(*[range(4)] * 3), axis=-1).reshape(-1, 3).astype(float)
        ours = ours[::-1] + 1
    else:
        count = {"one": 1, "two": 2}[case]
        ours, right = ours[:count], right[:count]
    table = np.sqrt(((ours[:, None] - right[None]) ** 2).sum(2))
    best = table[linear_sum_assignment(table)].mean()
    found = metrics.earth_mover_distance(batch(ours), batch(right))
    assert found.item() == pytest.approx(best, rel=1e-12)


@pytest.mark.parametrize("shift", [(0.01, 0, 0), (-0.02, 0.03, 0.06), (3.0, 4.0, 12.0)])
def test_a_translated_body_has_the_metrics_of_its_translation(bodies: list[Body], shift: tuple[float, ...]) -> None:
    meshes, faces = bodies[0]
    length = math.hypot(*shift)
    found = {name: float(value) for name, value in measured(batch(meshes[0] + shift), batch(meshes[0]), faces).items()}
    assert found["pmd"] == pytest.approx(length**2 / 3, rel=1e-9)
    assert found["euclidean"] == pytest.approx(length, rel=1e-9)
    # moving all vertices alike is the best assignment: the mean vector of any other is the same
    assert found["earth_mover"] == pytest.approx(length, rel=1e-9)
    assert found["chamfer"] <= 2 * length**2
    assert found["recentred"] == pytest.approx(0, abs=1e-12)
    assert found["edges"] == pytest.approx(0, abs=1e-9) and found["normals"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("factor", [0.5, 1.1, 3.0])
def test_a_scaled_body_has_the_metrics_of_its_scale(bodies: list[Body], factor: float) -> None:
    meshes, faces = bodies[0]
    body, change = meshes[1], factor - 1
    found = {name: float(value) for name, value in measured(batch(factor * body), batch(body), faces).items()}
    assert found["pmd"] == pytest.approx(change**2 * (body**2).mean(), rel=1e-9)
    assert found["euclidean"] == pytest.approx(abs(change) * np.linalg.norm(body, axis=1).mean(), rel=1e-9)
    assert found["edges"] == pytest.approx(abs(change), rel=1e-9)
    assert found["normals"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("degrees", [1.0, 40.0, 90.0])
def test_a_rotated_sphere_lies_on_itself_while_its_vertices_move(degrees: float) -> None:
    steps = (np.arange(4000) + 0.5) / 4000
    height, turn = 1 - 2 * steps, np.pi * (1 + 5**0.5) * np.arange(4000)
    flat = np.sqrt(1 - height**2)
    sphere = np.stack([flat * np.cos(turn), height, flat * np.sin(turn)], axis=1)
    angle = math.radians(degrees)
    about_y = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    rotated, truth = batch(sphere @ about_y.T), batch(sphere)
    chord = 2 * math.sin(angle / 2)  # of a vertex on the equator; the mean of flat^2 over a sphere is 2/3
    assert float(metrics.point_mesh_distance(rotated, truth)) == pytest.approx(chord**2 * 2 / 9, rel=1e-3)
    assert float(metrics.mean_euclidean_error(rotated, truth)) == pytest.approx(chord * math.pi / 4, rel=1e-3)
    spacing = math.sqrt(4 * math.pi / 4000)
    assert float(metrics.chamfer_distance(rotated, truth)) < 2 * spacing**2
    assert float(metrics.earth_mover_distance(rotated, truth, points=400)) < 3 * math.sqrt(4 * math.pi / 400)


def test_a_common_order_of_vertices_changes_nothing(bodies: list[Body]) -> None:
    meshes, faces = bodies[0]
    order = np.random.default_rng(2).permutation(len(meshes[0]))
    renumbered = np.argsort(order)[faces].astype(np.int32)
    found, again = (
        measured(batch(meshes[0][o]), batch(meshes[4][o]), f) for o, f in ((slice(None), faces), (order, renumbered))
    )
    for name, value in found.items():
        assert again[name].item() == pytest.approx(value.item(), rel=1e-10), name


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("side", [0, 1])
def test_what_is_not_finite_has_no_metric_and_spoils_no_other_mesh(bodies: list[Body], value: float, side: int) -> None:
    meshes, faces = bodies[0]
    pair = [batch(*meshes[:2]), batch(*meshes[3:5])]
    whole = measured(pair[0], pair[1], faces)
    pair[side] = pair[side].clone()
    pair[side][0, 17, 1] = value
    for name, found in measured(pair[0], pair[1], faces).items():
        assert found[0].isnan() and found[1] == whole[name][1], name


def test_chamfer_at_28920_vertices_stays_in_the_memory_of_the_meshes() -> None:
    random = torch.Generator().manual_seed(0)
    ours, right = (torch.rand(1, 28_920, 3, generator=random) for _ in range(2))
    before = _most_resident()
    tracemalloc.start()
    value = float(metrics.chamfer_distance(ours, right))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert 0 < value < 1e-2
    assert peak < 20e6, "of NumPy: a table of all distances takes 6.7 GB"
    assert _most_resident() - before < 200e6, "of torch and SciPy, which tracemalloc does not see"


def _most_resident() -> float:
    """Bytes of memory that this process has had at most."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_results_are_float64_and_need_no_gradient(bodies: list[Body], dtype: torch.dtype) -> None:
    meshes, faces = bodies[0]
    ours, right = batch(meshes[0]).to(dtype).requires_grad_(), batch(meshes[1]).to(dtype)
    for name, value in measured(ours, right, faces).items():
        assert value.dtype == torch.float64 and value.shape == (1,) and not value.requires_grad, name


@pytest.mark.gpu
def test_metrics_on_a_gpu_are_those_on_the_cpu_and_stay_there(bodies: list[Body]) -> None:
    for meshes, faces in bodies:
        ours, right = batch(*meshes[:3]), batch(*meshes[3:])
        found, there = measured(ours, right, faces), measured(ours.cuda(), right.cuda(), faces)
        for name, value in found.items():
            assert there[name].device.type == "cuda"
            torch.testing.assert_close(there[name].cpu(), value, rtol=1e-10, atol=1e-9, msg=name)
