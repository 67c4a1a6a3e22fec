import numpy as np
import pytest

from datagen.bodies.clothed.surface import borders, cut, subdivided, surface_of

SIDE = 6


def sheet() -> tuple[np.ndarray, np.ndarray]:
    """Quads [25, 4] and vertices [36, 3] of a square from (0, 0, 0) to (5, 5, 0)."""
    places = np.array([(x, y, 0.0) for x in range(SIDE) for y in range(SIDE)])
    corners = np.array([(SIDE * x + y) for x in range(SIDE - 1) for y in range(SIDE - 1)])
    return np.stack([corners, corners + SIDE, corners + SIDE + 1, corners + 1], axis=1), places


def area(faces: np.ndarray, places: np.ndarray) -> float:
    first, second, third = places[faces].transpose(1, 0, 2)
    return float(np.sqrt((np.cross(second - first, third - first) ** 2).sum(axis=1)).sum() / 2)


@pytest.mark.parametrize("height", [0.0, 0.2, 1.5, 2.0, 2.9, 4.4])
def test_a_cut_is_level_and_leaves_what_is_above_it(height: float) -> None:
    quads, places = sheet()
    whole = surface_of(quads, len(places))
    found = cut(whole, whole.of(places)[:, 1] - height)
    cut_places = found.of(places)
    assert area(found.faces, cut_places) == pytest.approx(5 * (5 - height), rel=0.02)
    assert cut_places[:, 1].min() == pytest.approx(height) and np.isclose(cut_places[:, 1], height).sum() >= SIDE
    lengths = np.linalg.norm(cut_places[found.faces] - np.roll(cut_places[found.faces], 1, axis=1), axis=2)
    assert lengths.min() > 0.3, "no slivers: a vertex near the cut is moved onto it"


def test_a_slanting_cut_of_a_cut_has_one_border_and_every_edge_at_most_two_faces() -> None:
    quads, places = sheet()
    surface = surface_of(quads, len(places))
    for level in (lambda p: p[:, 1] + 0.3 * p[:, 0] - 1.1, lambda p: 4.7 - p[:, 0] + 0.1 * p[:, 1]):
        surface = cut(surface, level(surface.of(places)))
    sides = np.sort(
        np.concatenate([surface.faces[:, [0, 1]], surface.faces[:, [1, 2]], surface.faces[:, [2, 0]]]), axis=1
    )
    assert np.unique(sides, axis=0, return_counts=True)[1].max() == 2
    assert len(borders(surface.faces)) == 1 and [len(its.faces) for its in surface.pieces()] == [len(surface.faces)]


def test_subdividing_keeps_the_surface_and_the_vertices_that_were_there() -> None:
    quads, places = sheet()
    before = surface_of(quads, len(places))
    after = subdivided(before)
    assert len(after.faces) == 4 * len(before.faces)
    assert np.array_equal(after.of(places)[: len(places)], before.of(places))
    assert area(after.faces, after.of(places)) == pytest.approx(25)


def test_pieces_are_told_apart_and_crumbs_left_out() -> None:
    quads, places = sheet()
    whole = surface_of(quads, len(places))
    apart = whole.keep(np.abs(places[whole.faces][:, :, 0].mean(axis=1) - 1.5) > 0.5)
    assert len(borders(apart.faces)) == 2
    assert sorted(area(its.faces, its.of(places)) for its in apart.pieces()) == pytest.approx([5, 15])
    middles = places[whole.faces].mean(axis=1)
    crumb = whole.keep((middles[:, 0] > 2) | (middles[:, :2] < 1).all(axis=1))
    assert [area(its.faces, its.of(places)) for its in crumb.pieces()] == pytest.approx([15])
