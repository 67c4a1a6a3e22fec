"""Meshes as networks read them: without noise along their edges, and points with neighbours of their own."""

from typing import Any

import numpy as np
import pytest
import torch

from datagen.mesh.geometry import Mesh
from datagen.mesh.low_pass import LowPass
from tests.support.shapes.avatars import noisy, sphere
from tests.support.three_networks import lively
from training.inference.mesh_reading import (
    lists_alike,
    posed_targets,
    read_targets,
    stacked,
    surface_of_meshes,
    transferred,
)
from training.networks.layers.sampling import Sample
from training.networks.parts import Parts
from training.recipes.networks import PEOPLE

NO_FACES = np.zeros((0, 3), np.int64)


@pytest.mark.parametrize("rough", [True, False])
def test_a_rough_mesh_is_read_filtered_and_posed_as_it_is(rough: bool) -> None:
    network, ball = lively("parts").eval(), noisy(sphere(subdivisions=3), 0.02 if rough else 0.0)
    read = read_targets(network, [ball])
    assert torch.equal(read.vertices, stacked(network, [ball.vertices]))
    assert torch.equal(read.as_read, read.vertices) != rough
    as_it_is = posed_targets(network, [ball], [ball], read)[0]
    even = posed_targets(network, [ball], [ball], read._replace(vertices=read.as_read))[0]
    moved = (read.vertices - read.as_read).abs().mean()
    assert (as_it_is - even).abs().mean() >= 0.3 * moved and (moved > 0) == rough


@pytest.mark.parametrize(
    ("people", "subdivisions", "of_target"), [(True, 3, 3), (True, 3, 2), (True, 2, 2), (False, 3, 3)]
)
def test_what_a_person_is_read_through_the_output_is_read_through(
    people: bool, subdivisions: int, of_target: int
) -> None:
    """Eight times of 642 vertices, the source alone where the target has 162; twice of 162, and of animals."""
    network = lively("parts", **({"joints": PEOPLE} if people else {})).eval()
    source, target = noisy(sphere(subdivisions=subdivisions), 0.03), sphere(subdivisions=of_target)
    read, (surface,) = network.read_target(stacked(network, [target.vertices])), [surface_of_meshes([source])]
    strong, both = people and subdivisions == 3, people and subdivisions == of_target == 3
    filtered = stacked(network, [LowPass(source.faces, len(source.vertices))(source.vertices, 8 if strong else 2)])

    def heard(outputs: torch.Tensor) -> torch.Tensor:
        return stacked(network, [LowPass(target.faces, len(target.vertices))(outputs[0].numpy(), 8)])

    named = {"twice": torch.tensor([True]), "alike": torch.tensor([subdivisions == of_target])}
    with torch.no_grad():
        expected = network.posed_target(filtered, read, surface, heard=heard if both else None, **named)
        otherwise = network.posed_target(filtered, read, surface, heard=None if both else heard, **named)
    posed = posed_targets(network, [source], [target], read)
    torch.testing.assert_close(posed, expected, rtol=0, atol=1e-5)
    assert (posed - otherwise).abs().max() > 1e-4


def test_points_and_what_is_filtered_are_read_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each by itself: what else is in a batch changes nothing."""
    network, asked = lively("parts", joints=PEOPLE).eval(), list[list[bool] | None]()
    real, ball, rough = Parts.posed_target, sphere(subdivisions=3), noisy(sphere(subdivisions=3), 0.03)

    def posed_target(*given: Any, twice: torch.Tensor | None, **named: Any) -> torch.Tensor:
        asked.append(None if twice is None else twice.tolist())
        return real(*given, twice=twice, **named)

    monkeypatch.setattr(Parts, "posed_target", posed_target)
    sources = [ball, rough, Mesh(ball.vertices, NO_FACES)]
    together = transferred(network, sources, [ball] * 3)
    alone = [transferred(network, [source], [ball])[0] for source in sources]
    assert asked == [[False, True, True], None, [True], [True]]
    torch.testing.assert_close(together, torch.stack(alone), atol=1e-5, rtol=1e-4)
    monkeypatch.setattr(network, "joints", (*PEOPLE, "left_wing", "right_wing"))
    transferred(network, sources, [ball] * 3)
    assert asked[-1] is None, "what is known of people need not hold for others"


def test_a_source_that_lists_the_targets_vertices_is_read_where_the_target_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each by itself: what else is in a batch changes nothing."""
    network, ball = lively("parts").eval(), noisy(sphere(subdivisions=4), 0.003)
    moved = Mesh(noisy(sphere(subdivisions=4), 0.002).vertices * [1.0, 1.3, 0.8], ball.faces)
    sources = [moved, Mesh(moved.vertices, moved.faces[::-1]), Mesh(moved.vertices, NO_FACES)]
    read, asked, real = read_targets(network, [ball] * 3), list[torch.Tensor](), Parts._rotations

    def rotations(self: Parts, drawn: Sample, twice: torch.Tensor | None) -> torch.Tensor:
        asked.append(drawn.rows)
        return real(self, drawn, twice)

    monkeypatch.setattr(Parts, "_rotations", rotations)
    together = transferred(network, sources, [ball] * 3)
    assert torch.equal(asked[0], read.drawn.rows)
    for number, source in enumerate(sources):
        asked.clear()
        alone = transferred(network, [source], [ball])[0]
        assert torch.equal(asked[0], read.drawn.rows[:1]) == (number == 0)
        torch.testing.assert_close(together[number], alone, atol=1e-5, rtol=1e-4)


def test_unwelded_meshes_do_not_tell_by_their_faces_which_vertices_they_list() -> None:
    ball = sphere(subdivisions=3)
    quads = np.arange(4 * len(ball.faces)).reshape(-1, 4)
    for corners, faces in (
        (ball.faces, np.arange(3 * len(ball.faces)).reshape(-1, 3)),
        (ball.faces[:, [0, 1, 2, 2]], np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])),
    ):
        soup, other = (Mesh(ball.vertices[order].reshape(-1, 3), faces) for order in (corners, corners[::-1]))
        assert not lists_alike(soup, other) and not lists_alike(soup, soup)
    assert lists_alike(ball, noisy(ball, 0.1)) and not lists_alike(ball, Mesh(ball.vertices, ball.faces[:, ::-1]))
    assert not lists_alike(ball, sphere(subdivisions=2)) and lists_alike(*[Mesh(ball.vertices, ball.faces[:-3])] * 2)
    loose = Mesh(np.concatenate([ball.vertices, ball.vertices[:1]]), ball.faces)
    assert not lists_alike(loose, loose) and not lists_alike(*[Mesh(ball.vertices, NO_FACES)] * 2)


@pytest.mark.parametrize(("subdivisions", "times"), [(2, 2), (3, 8), (4, 8), (5, 17)])
def test_the_finer_a_person_is_meshed_the_more_often_it_is_filtered(subdivisions: int, times: int) -> None:
    network, rough = lively("parts", joints=PEOPLE).eval(), noisy(sphere(subdivisions=subdivisions), 0.08)
    expected = LowPass(rough.faces, len(rough.vertices))(rough.vertices, times)
    read = read_targets(network, [rough]).as_read[0].numpy()
    both = [each - each.min(axis=0) for each in (expected, read)]
    np.testing.assert_allclose(both[1] / both[1].max(), both[0] / both[0].max(), atol=1e-5)


def test_rounded_coordinates_are_no_noise() -> None:
    network, fine = lively("parts").eval(), sphere(subdivisions=6)
    for mesh, filtered in ((Mesh(fine.vertices.round(3), fine.faces), False), (noisy(fine, 0.01), True)):
        read = read_targets(network, [mesh])
        assert torch.equal(read.as_read, read.vertices) != filtered


def test_loose_vertices_do_not_make_a_mesh_smooth() -> None:
    network, rough = lively("parts").eval(), noisy(sphere(subdivisions=4), 0.02)
    loose = Mesh(np.tile(rough.vertices, (11, 1)), rough.faces)  # ten of eleven vertices have no face, and stay
    read = read_targets(network, [loose])
    assert not torch.equal(read.as_read, read.vertices)
    points = read_targets(network, [Mesh(rough.vertices, NO_FACES)])
    assert torch.equal(points.as_read, points.vertices)


@pytest.mark.parametrize("people", [False, True])
def test_what_is_filtered_and_posed_does_not_depend_on_what_else_is_in_a_batch(people: bool) -> None:
    network = lively("parts", **({"joints": PEOPLE} if people else {})).eval()
    meshes = [noisy(sphere(subdivisions=3), spread) for spread in (0.0, 0.05)]
    together = transferred(network, meshes, meshes[::-1])
    for place, (source, target) in enumerate(zip(meshes, meshes[::-1], strict=True)):
        alone = transferred(network, [source], [target])[0]
        torch.testing.assert_close(together[place], alone, atol=1e-5, rtol=1e-4)


def test_a_mesh_that_is_broken_breaks_no_other() -> None:
    network, ball = lively("parts").eval(), sphere(subdivisions=2)
    points = Mesh(ball.vertices, NO_FACES)
    broken = Mesh(np.where(np.arange(len(ball.vertices))[:, None] == 3, np.nan, ball.vertices), NO_FACES)
    output = transferred(network, [points, broken], [points, points])
    assert output[0].isfinite().all() and output[1].isnan().all()


def test_networks_without_weights_are_called_on_the_cpu() -> None:
    class Copier(torch.nn.Module):
        def forward(self, *, source: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
            return source

    ball = sphere(subdivisions=1)
    assert torch.equal(transferred(Copier(), [ball], [ball]), stacked(Copier(), [ball.vertices]))


def test_points_do_not_join_what_faces_keep_apart() -> None:
    """Two sheets that touch, and a stray vertex between them."""
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 0.5, 11), indexing="ij"))
    low = np.stack([x, 0 * x, z], axis=1)
    corner = (np.arange(20)[:, None] * 11 + np.arange(10)).ravel()
    sheet = np.concatenate([corner[:, None] + [0, 1, 11], corner[:, None] + [1, 12, 11]])
    seam = [[0 + 220, 231 + 220, 221]]  # joined at one end alone
    folded = np.concatenate([sheet, sheet + 231, seam])
    both = np.concatenate([low, low + np.array([0, 0.02, 0])])
    stray = np.concatenate([both, [[0.2, 0.01, 0.25]]])
    for vertices in (both, stray):
        found = surface_of_meshes([Mesh(vertices, folded)])
        one, other = (int(found.cells[0, np.abs(vertices - [0.2, y, 0.25]).sum(1).argmin()]) for y in (0, 0.02))
        assert one != other and not found.near[0, one, other]


@pytest.mark.parametrize("pieces", [1, 2])
def test_points_that_touch_are_not_near_along_the_surface_where_the_way_round_is_long(pieces: int) -> None:
    """A strip folded like a U, of points alone: its arms are 0.12 apart, points 0.02."""
    along, wide = np.linspace(0, 1, 50), np.linspace(0, 0.2, 11)
    arms = np.concatenate([np.stack([along, np.full(50, side), 0 * along], 1) for side in (-0.06, 0.06)])
    bend = np.linspace(-np.pi / 2, np.pi / 2, 10)[1:-1]
    arc = np.stack([1 + 0.06 * np.cos(bend), 0.06 * np.sin(bend), 0 * bend], axis=1)
    line = np.concatenate([arms, arc] if pieces == 1 else [arms])
    points = (line[:, None] + wide[:, None] * [0, 0, 1]).reshape(-1, 3)
    surface = surface_of_meshes([Mesh(points, NO_FACES)])
    cell = {
        side: int(surface.cells[0, np.linalg.norm(points - [0, side, 0], axis=1).argmin()]) for side in (-0.06, 0.06)
    }
    assert bool(surface.near[0, cell[-0.06], cell[0.06]]) == (pieces == 2)  # of pieces apart nobody knows
    assert bool(surface.near[0, cell[0.06], cell[0.06]])
