"""Disturbances: nothing at amount 0, the same twice, more of one draw with more, and each what its name says."""

import numpy as np
import pytest

from datagen.mesh.geometry import Mesh, bounding_box, check_mesh, edges_of
from training.evaluation.disturbances import DISTURBANCES, Disturbance
from training.inference.mesh_reading import normalised

BY_NAME = {its.name: its for its in DISTURBANCES}
every = pytest.mark.parametrize("disturbance", DISTURBANCES, ids=lambda its: its.name)


def tube(rings: int = 24, segments: int = 12) -> Mesh:
    """A closed-sided tube along X, 2 long and 0.6 thick, away from the origin."""
    along, around = np.divmod(np.arange(rings * segments), segments)
    angle = 2 * np.pi * around / segments
    vertices = np.stack([5 + 2 * along / (rings - 1), 1 + 0.3 * np.cos(angle), 0.3 * np.sin(angle) - 2], axis=1)
    quads = np.arange((rings - 1) * segments)
    right = quads - quads % segments + (quads + 1) % segments
    faces = np.concatenate(
        [np.stack([quads, right, quads + segments], 1), np.stack([right, right + segments, quads + segments], 1)]
    )
    return Mesh(vertices, faces)


def area(mesh: Mesh) -> float:
    corners = mesh.vertices[mesh.faces]
    return float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum())


@every
def test_amount_zero_gives_the_mesh_back(disturbance: Disturbance) -> None:
    mesh = tube()
    same = disturbance.apply(mesh, 0, 7)
    assert disturbance.amounts[0] == 0 and list(disturbance.amounts) == sorted(set(disturbance.amounts))
    np.testing.assert_allclose(same.vertices, mesh.vertices, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(same.faces, mesh.faces)


@every
def test_the_same_seed_gives_the_same_bits_and_the_given_mesh_stays(disturbance: Disturbance) -> None:
    mesh = tube()
    before = mesh.vertices.copy(), mesh.faces.copy()
    for amount in disturbance.amounts[1:]:
        one, two = (disturbance.apply(mesh, amount, 3) for _ in range(2))
        np.testing.assert_array_equal(one.vertices, two.vertices)
        assert np.isfinite(one.vertices).all() and len(one.vertices) >= 3
        if len(one.faces):
            check_mesh(one, name=disturbance.name)
    np.testing.assert_array_equal(mesh.vertices, before[0])
    np.testing.assert_array_equal(mesh.faces, before[1])


@every
def test_counts_are_kept_by_those_that_say_so_only(disturbance: Disturbance) -> None:
    counts = [len(disturbance.apply(tube(), amount, 0).vertices) for amount in disturbance.amounts[1:]]
    assert all(count == len(tube().vertices) for count in counts) == disturbance.keeps_count


@every
def test_those_that_change_nothing_are_taken_away_by_the_normalisation(disturbance: Disturbance) -> None:
    mesh, most = tube(), disturbance.amounts[-1]
    difference = np.abs(normalised(disturbance.apply(mesh, most, 0).vertices)[:3] - normalised(mesh.vertices)[:3]).max()
    assert (difference < 1e-6) == disturbance.changes_nothing or disturbance.name == "subdivide"


def test_noise_has_the_standard_deviation_that_was_asked_and_grows_along_one_draw() -> None:
    mesh = tube(200, 40)
    little, much = (BY_NAME["noise"].apply(mesh, amount, 1).vertices - mesh.vertices for amount in (0.02, 0.1))
    assert much.std() == pytest.approx(0.1 * bounding_box(mesh.vertices).half, rel=0.02)
    np.testing.assert_allclose(much, 5 * little, atol=1e-12)


def test_a_patch_is_connected_of_the_share_asked_and_within_a_larger_one() -> None:
    mesh = tube()
    removed = {}
    for amount in (0.1, 0.3):
        kept = {tuple(vertex) for vertex in BY_NAME["patch"].apply(mesh, amount, 5).vertices}
        removed[amount] = {place for place, vertex in enumerate(mesh.vertices) if tuple(vertex) not in kept}
        assert len(removed[amount]) == round(amount * len(mesh.vertices))
        reached, edges = {min(removed[amount])}, edges_of(mesh.faces).tolist()
        for _ in removed[amount]:
            reached |= {b for a, b in edges if a in reached} | {a for a, b in edges if b in reached}
            reached &= removed[amount]
        assert reached == removed[amount]
    assert removed[0.1] < removed[0.3]


def test_the_side_that_is_cut_is_the_one_towards_x() -> None:
    cut = BY_NAME["side"].apply(tube(), 0.5, 0)
    assert (cut.vertices[:, 0].min(), cut.vertices[:, 0].max()) == (5, pytest.approx(6.5, abs=2 / 23))


def test_points_of_a_resampled_surface_lie_on_it_evenly() -> None:
    mesh = tube(rings=6, segments=64)
    points = BY_NAME["area"].apply(mesh, 8, 2).vertices
    assert len(points) == 8 * len(mesh.vertices)
    radius = np.linalg.norm(points[:, 1:] - (1, -2), axis=1)
    assert (radius > 0.299).all() and (radius < 0.3 + 1e-9).all()
    assert np.histogram(points[:, 0] - 5, bins=4, range=(0, 2))[0] == pytest.approx(len(points) / 4, rel=0.1)


def test_points_by_face_are_as_many_on_every_face_and_by_area_are_not() -> None:
    large, small = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0]]), np.array([[10, 0, 0], [11, 0, 0], [10, 1, 0]])
    mesh = Mesh(np.concatenate([large, small]).astype(float), np.array([[0, 1, 2], [3, 4, 5]]))
    shares = [(BY_NAME[name].apply(mesh, 1000, 1).vertices[:, 0] >= 10).mean() for name in ("face", "area")]
    assert shares == pytest.approx([1 / 2, 1 / 17], abs=0.02)


def test_subdivision_keeps_the_surface_and_quarters_the_faces() -> None:
    mesh = tube()
    fine = BY_NAME["subdivide"].apply(mesh, 2, 0)
    assert len(fine.faces) == 16 * len(mesh.faces) and area(fine) == pytest.approx(area(mesh))
    assert len(np.unique(fine.vertices.round(9), axis=0)) == len(fine.vertices), "a side's middle is one vertex"


def test_merging_cells_leaves_one_vertex_a_cell_inside_it() -> None:
    mesh, cell = tube(), 0.2
    merged = BY_NAME["cells"].apply(mesh, cell, 0)
    corner = mesh.vertices.min(0)
    cells = np.floor((merged.vertices - corner) / (cell * bounding_box(mesh.vertices).half))
    assert len(np.unique(cells, axis=0)) == len(merged.vertices) < len(mesh.vertices)
    assert (np.diff(np.sort(merged.faces, axis=1), axis=1) > 0).all()


@pytest.mark.parametrize(("axis", "expected"), [("x", (0, 0, 1)), ("y", (1, 0, 0)), ("z", (0, 1, 0))])
def test_turns_are_right_handed(axis: str, expected: tuple[int, int, int]) -> None:
    start = {"x": (0, 1, 0), "y": (0, 0, 1), "z": (1, 0, 0)}[axis]
    ends = np.array([start, np.negative(start)], float)
    turned = BY_NAME[f"turn-{axis}"].apply(Mesh(ends, np.empty((0, 3), int)), 90, 0)
    np.testing.assert_allclose(turned.vertices[0], expected, atol=1e-12)
