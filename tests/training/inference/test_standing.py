"""How a mesh stands, found by what a network understands; here by one that knows a single body and says so exactly."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from datagen.mesh.geometry import Mesh, bounding_box
from tests.support.three_networks import lively
from training.inference import standing as module
from training.inference.standing import Standing, facing, misfit, standing

RANDOM = np.random.default_rng(3)
BODY = RANDOM.normal(size=(80, 3)) * (0.3, 1, 0.2)


def drawn(mesh: NDArray[np.floating]) -> NDArray[np.intp]:
    """The numbers of a mesh' vertices, as they are drawn."""
    seen = list[NDArray[np.floating]]()

    def watched(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        seen.extend(meshes)
        return np.zeros(1), np.eye(3)[None]

    misfit(watched, mesh)
    return cdist(seen[0], bounding_box(mesh).normalise(mesh)).argmin(axis=1)


ORDER = drawn(BODY)


def turns_of(meshes: NDArray[np.floating]) -> list[Rotation]:
    """How each of some meshes, of the first vertices that are drawn, is turned from upright."""
    known = BODY[ORDER[: meshes.shape[1]]]
    known = known - known.mean(axis=0)
    return [Rotation.align_vectors(mesh - mesh.mean(axis=0), known)[0] for mesh in meshes]


def understand(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Misfit grows with the angle from upright; how it is turned is known to 40 degrees, as it is to a network."""
    turns = turns_of(meshes)
    angles = np.array([turn.magnitude() for turn in turns])
    known_to = np.radians(40)
    roots = [turn.as_matrix() if turn.magnitude() < known_to else np.eye(3) for turn in turns]
    return 0.0005 + 0.02 * (1 - np.cos(angles)), np.stack(roots)


def understand_in_part(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """As `understand`, but of a larger turn 25 degrees are read."""
    vectors = np.stack([turn.as_rotvec() for turn in turns_of(meshes)])
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    read = vectors * np.minimum(1, np.radians(25) / np.maximum(angles, 1e-9))
    return understand(meshes)[0], Rotation.from_rotvec(read).as_matrix()


def understand_leaning(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """As `understand`, but bodies that lean by up to 20 degrees are as well understood as upright ones."""
    angles = np.maximum(0, [turn.magnitude() - np.radians(20) for turn in turns_of(meshes)])
    return 0.0005 + 0.02 * (1 - np.cos(angles)), understand(meshes)[1]


def left_over(turn: Rotation) -> float:
    """Degrees that a body turned so is from upright after it was turned as was found, its lean included."""
    found = standing(understand, turn.apply(BODY) * 40 + 7)
    return float(np.degrees((Rotation.from_matrix(found.lean.T @ found.matrix) * turn).magnitude()))


def test_an_upright_body_is_left_exactly_as_it_is() -> None:
    found = standing(understand, BODY)
    assert np.array_equal(found.matrix, np.eye(3)) and found.misfit == pytest.approx(0.0005)
    slightly = Rotation.from_euler("y", 5, degrees=True).apply(BODY)
    assert np.array_equal(standing(understand, slightly).matrix, np.eye(3)), "it may be an error of the network's own"


@pytest.mark.parametrize(("by_more", "facing_by"), [(0.0005, 0), (0.0005, 10), (0.0030, 0)])
def test_a_mesh_that_few_vertices_do_not_understand_as_it_is_is_read_by_more_before_it_is_turned(
    by_more: float, facing_by: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lean that few vertices like better is not taken: the mesh is understood as it is, or that is in doubt."""
    for name, count in {"_FIRST_VERTICES": 20, "_VERTICES": 30, "_MORE_VERTICES": 80}.items():
        monkeypatch.setattr(f"training.inference.standing.{name}", count)
    lean, read = Rotation.from_euler("x", 28, degrees=True), list[int]()

    def confused(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        read.append(meshes.shape[1])
        misfits, roots = understand(meshes)
        if meshes.shape[1] == 80:
            return misfits - 0.0005 + by_more, roots
        leaning = np.array([(turn * lean.inv()).magnitude() for turn in turns_of(meshes)])
        return 0.0025 + 0.02 * (1 - np.cos(leaning)), roots

    turn = Rotation.from_euler("y", facing_by, degrees=True)
    found = standing(confused, turn.apply(BODY))
    assert read[:2] == [30, 80] and (30 in read[2:]) == (by_more > 0.002)
    assert np.degrees((Rotation.from_matrix(found.matrix) * turn).magnitude()) < 2
    assert np.array_equal(found.lean, np.eye(3))


@pytest.mark.parametrize(
    ("own", "times", "enough"), [(0.0005, 6.2, True), (0.0005, 5.8, False), (0.0015, 6.2, True), (0.0015, 5.8, False)]
)
def test_other_ways_are_read_well_only_where_a_few_vertices_leave_a_doubt(
    own: float, times: float, enough: bool
) -> None:
    read = list[tuple[int, ...]]()

    def watched(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        read.append(meshes.shape[:2])
        misfits, roots = understand(meshes)
        return misfits - 0.0005 + own if meshes.shape[1] == len(BODY) else np.full(len(meshes), times * own), roots

    found = standing(watched, BODY)
    assert np.array_equal(found.matrix, np.eye(3))
    assert read == [(1, 80), (1, 80), (2, 64), (2, 80)][: 3 if enough else 4], "of aside; what is behind is read well"


@pytest.mark.parametrize("angle", [30, 60, 89, 90, 120, 180, 271])
def test_a_turn_about_the_vertical_is_found_without_all_other_ways(angle: float) -> None:
    read = list[int]()

    def watched(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        read.append(len(meshes))
        return understand(meshes)

    standing(watched, Rotation.from_euler("y", angle, degrees=True).apply(BODY))
    assert sum(read) <= 20


@pytest.mark.parametrize(("misfit_behind", "is_taken"), [(0.0008, True), (0.0017, False)])
def test_a_way_about_the_vertical_that_is_understood_so_so_is_taken_only_where_no_other_is_better(
    misfit_behind: float, is_taken: bool
) -> None:
    """A body that leans by 45 degrees, and is taken for one that leans the other way when it is turned round."""
    lean = Rotation.from_euler("x", 45, degrees=True)
    behind = Rotation.from_euler("y", 180, degrees=True) * lean

    def confused(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        misfits, roots = understand(meshes)
        is_behind = np.array([(behind.inv() * turn).magnitude() < 0.3 for turn in turns_of(meshes)])
        return np.where(is_behind, misfit_behind, misfits), roots

    found = standing(confused, lean.apply(BODY))
    left = (Rotation.from_matrix(found.lean.T @ found.matrix) * lean).magnitude()
    assert (left > 3) == is_taken and (left < 0.1) == (not is_taken)


def test_a_turn_about_the_vertical_stays_one_where_no_other_way_is_clearly_better() -> None:
    """Of a body that bows a little and is never understood well, as one in clothes."""

    def roughly(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        misfits, roots = understand(meshes)
        return np.maximum(misfits, 0.0015), roots

    found = standing(roughly, Rotation.from_euler("yx", [120, 10], degrees=True).apply(BODY))
    assert np.array_equal(found.lean, np.eye(3)) and np.allclose(found.matrix[1], [0, 1, 0])


def test_what_is_broken_is_understood_in_no_way_and_no_error() -> None:
    nothing = np.full((1, 3, 3), np.nan)
    found = standing(lambda meshes: (np.full(len(meshes), np.nan), np.repeat(nothing, len(meshes), axis=0)), BODY)
    assert np.array_equal(found.matrix, np.eye(3)) and np.isnan(found.misfit)


def test_a_body_that_was_just_found_to_stand_is_not_read_again_to_see_whether_it_leans() -> None:
    turn = Rotation.from_euler("yx", [70, 30], degrees=True)
    found, read = standing(understand, turn.apply(BODY)), list[int]()

    def watched(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        read.append(len(meshes))
        return understand(meshes)

    upright = found.turned(turn.apply(BODY))
    assert np.allclose(facing(watched, upright, found), facing(understand, upright, found.lean)) and not read
    facing(watched, upright, replace(found, root=None))
    assert read == [1], "of one that somebody else says how it stands"


def test_vertices_are_drawn_by_the_area_around_them_and_not_for_lying_far_off() -> None:
    """Of a plate that is meshed four times as densely on one half, a half of the first; and how it is turned is one."""
    coarse, fine = RANDOM.uniform(-1, 0, (120, 2)), RANDOM.uniform((0, -1), (1, 0), (480, 2))
    stray = 3 + RANDOM.normal(size=(12, 3))
    body = np.concatenate([np.pad(np.concatenate([coarse, fine]), ((0, 0), (0, 1))), stray])
    first = drawn(body)[:100]
    assert 0.38 < np.mean(first < 120) < 0.58 and np.sum(first[:20] >= 600) <= 6
    turned = Rotation.from_euler("yx", [30, 60], degrees=True).apply(body) * 40 + 7
    assert np.array_equal(drawn(turned)[:100], first)


def test_vertices_that_are_no_numbers_are_no_error_here() -> None:
    broken = BODY.copy()
    broken[3] = np.nan
    seen = list[NDArray[np.floating]]()
    misfit(lambda meshes: (seen.extend(meshes), (np.zeros(1), np.eye(3)[None]))[1], broken)
    assert len(seen[0]) == len(BODY) and np.isnan(seen[0]).any()


def test_a_way_that_is_misread_is_turned_by_quarters_about_all_axes_and_then_to_face_ahead(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By the surface, which knows how it stands; facing is read to half of what it is, as far as 40 degrees."""
    turns = [Rotation.from_matrix(turn) for turn in module._QUARTER_TURNS]
    assert len(turns) == 23 and all(turn.magnitude() > 1.5 for turn in turns)
    faces = np.empty((0, 3), np.int64)

    def read(_: object, mesh: Mesh) -> tuple[float, NDArray[np.float64]]:
        turn = Rotation.align_vectors(mesh.vertices, BODY)[0]
        aside = Rotation.from_euler("y", 0.5 * turn.as_euler("yxz", degrees=True)[0], degrees=True)
        degrees = float(np.degrees(turn.magnitude()))
        return 3 + 0.3 * degrees, aside.as_matrix() if degrees < 40 else np.eye(3)

    monkeypatch.setattr(module, "understanding_of", lambda _: understand)
    monkeypatch.setattr(module, "_read", read)
    monkeypatch.setattr(module, "rest_error", lambda network, mesh: read(network, mesh)[0])
    for lost in (*turns, *(turn * Rotation.from_euler("y", 39, degrees=True) for turn in turns[:4])):
        mesh = Mesh(lost.apply(BODY), faces)
        monkeypatch.setattr(module, "_found", lambda *_: Standing(np.eye(3), 0.02))
        found = module.stands(lively("parts"), mesh)
        left = np.degrees((Rotation.from_matrix(found.matrix) * lost).magnitude())
        assert left < 10 and found.rest_error < 7, lost.as_rotvec(degrees=True)


def test_of_a_body_that_leans_no_way_by_quarters_is_tried_and_no_facing(monkeypatch: pytest.MonkeyPatch) -> None:
    lean = Standing(np.eye(3), 0.003, lean=Rotation.from_euler("x", 30, degrees=True).as_matrix())
    monkeypatch.setattr(module, "_found", lambda *_: lean)
    body = Mesh(BODY, np.empty((0, 3), np.int64))
    monkeypatch.setattr(
        module, "_read", lambda _, mesh: (20.0 if np.array_equal(mesh.vertices, body.vertices) else 1.0, np.eye(3))
    )
    monkeypatch.setattr(module, "rest_error", lambda *_: 9.0)
    found = module.stands(lively("parts"), body)
    assert np.array_equal(found.lean, lean.lean) and found.rest_error == 9.0


@pytest.mark.parametrize("angle", [-170, -95, -30, 10, 47, 120, 180])
def test_a_turn_about_the_vertical_is_undone_and_no_lean_with_it(angle: float) -> None:
    assert left_over(Rotation.from_euler("y", angle, degrees=True)) < 0.1


def test_ways_that_a_few_vertices_rank_wrongly_are_read_by_more() -> None:
    """Of a body that lies, a dozen ways to stand upside down seem best by the vertices that rank them."""
    read = list[int]()

    def understand_by_rank(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        misfits, roots = understand(meshes)
        if meshes.shape[1] == len(BODY):
            read.append(len(meshes))
            return misfits, roots
        misfits[np.argsort(misfits)[-12:]] = 0.0001
        return misfits, roots

    turn = Rotation.from_euler("zx", [80, 65], degrees=True)
    found = standing(understand_by_rank, turn.apply(BODY))
    assert np.degrees((Rotation.from_matrix(found.lean.T @ found.matrix) * turn).magnitude()) < 0.1
    assert max(read) < 100, "no more are read by all vertices than the ranking leaves"


@pytest.mark.parametrize("number", range(8))
def test_a_body_that_lies_anyhow_is_set_upright(number: int) -> None:
    assert left_over(Rotation.random(random_state=number)) < 0.1


@pytest.mark.parametrize(("axis", "degrees", "leans"), [("x", 30, True), ("z", -45, True), ("x", 58, False)])
def test_a_lean_from_the_way_up_of_the_file_is_told_from_another_way_up(axis: str, degrees: int, leans: bool) -> None:
    """A body is turned about the vertical to face +Z, and its lean is kept; beyond 50 degrees it counts as lying."""
    turn = Rotation.from_euler("y", 70, degrees=True) * Rotation.from_euler(axis, degrees, degrees=True)
    found = standing(understand, turn.apply(BODY))
    assert left_over(turn) < 0.1
    leaning = np.degrees(np.arccos(found.lean[1, 1]))
    assert leaning == pytest.approx(abs(degrees) if leans else 0, abs=0.1)
    if leans:
        assert found.matrix[1] == pytest.approx([0, 1, 0]), "what is up in the file stays so"
        assert found.upright(turn.apply(BODY)) == pytest.approx(BODY, abs=0.01)


def test_what_is_understood_in_no_way_is_left_alone() -> None:
    found = standing(lambda meshes: (np.full(len(meshes), 0.05), np.tile(np.eye(3), (len(meshes), 1, 1))), BODY)
    assert np.array_equal(found.matrix, np.eye(3)) and found.misfit == 0.05


def test_a_body_that_leans_along_the_axes_of_its_file_is_left_leaning_in_any_file() -> None:
    lean, z_up = Rotation.from_euler("x", 16, degrees=True), Rotation.from_euler("x", 90, degrees=True)
    for axes in (Rotation.identity(), z_up):
        found = Rotation.from_matrix(standing(understand_leaning, (axes * lean).apply(BODY)).matrix)
        assert np.degrees((found * axes).magnitude()) < 1


def test_of_a_misread_root_the_way_along_the_axes_is_kept() -> None:
    def misread(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        misfits, roots = understand(meshes)
        return misfits, Rotation.from_euler("z", 70, degrees=True).as_matrix() @ roots

    turn = Rotation.random(random_state=2)
    found = standing(misread, turn.apply(BODY))
    assert found.misfit < 0.01, "no worse than the best way that was seen"


@pytest.mark.parametrize("lean", [0, 8, 20, 35])
def test_of_a_body_that_clearly_leans_the_lean_is_found_and_a_little_of_it_is_left(lean: float) -> None:
    frame = Rotation.from_euler("x", lean, degrees=True)
    turn = Rotation.from_matrix(facing(understand, frame.apply(BODY), np.eye(3)))
    left = np.degrees((turn.inv() * frame).magnitude())
    assert left == pytest.approx(lean if lean < 12 else 0, abs=0.1)
    straight = Rotation.from_matrix(facing(understand, BODY, turn.as_matrix()))  # the next frame stands straight again
    assert np.degrees(straight.magnitude()) < 12


def test_a_lean_is_composed_with_the_way_that_the_body_faced() -> None:
    before = Rotation.from_euler("y", 120, degrees=True)
    for lean in (25, 50):  # the latter takes two rounds: a root is known to 40 degrees
        frame = before * Rotation.from_euler("x", lean, degrees=True)
        turn = Rotation.from_matrix(facing(understand_in_part, frame.apply(BODY), before.as_matrix()))
        assert np.degrees((turn.inv() * frame).magnitude()) < 1


def test_a_body_that_turns_round_is_followed_from_frame_to_frame() -> None:
    turn = np.eye(3)
    for angle in range(0, 360, 25):
        frame = Rotation.from_euler("y", angle, degrees=True)
        turn = facing(understand, frame.apply(BODY), turn)
        assert np.degrees((Rotation.from_matrix(turn).inv() * frame).magnitude()) < 7
        assert misfit(understand, frame.apply(BODY) @ turn) < 0.001


@pytest.mark.parametrize(
    ("aside", "lean", "stays"), [(8, 0, True), (12, 0, False), (8, 30, True), (12, 30, True), (20, 30, False)]
)
def test_a_facing_is_undone_from_9_degrees_on_and_of_a_body_that_leans_from_18(
    aside: float, lean: float, stays: bool
) -> None:
    root = Rotation.from_euler("YX", [aside, lean], degrees=True)

    def read(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return understand(meshes)[0], np.stack([(turn * root).as_matrix() for turn in turns_of(meshes)])

    assert np.array_equal(standing(read, BODY).matrix, np.eye(3)) == stays


@pytest.mark.parametrize(
    ("as_it_is", "facing_by", "stays"), [(4.7, 0, True), (4.9, 8, True), (4.7, 30, False), (5.1, 0, False)]
)
def test_another_way_is_not_taken_where_the_surface_is_read_as_well_as_it_is(
    monkeypatch: pytest.MonkeyPatch, as_it_is: float, facing_by: float, stays: bool
) -> None:
    root = Rotation.from_euler("y", facing_by, degrees=True).as_matrix()
    round_about = Standing(Rotation.from_euler("y", 180, degrees=True).as_matrix(), 0.001)
    monkeypatch.setattr(module, "_found", lambda *_: round_about)
    monkeypatch.setattr(module, "rest_error", lambda *_: 4.0)
    body = Mesh(BODY, np.empty((0, 3), np.int64))
    monkeypatch.setattr(
        module,
        "_read",
        lambda _, mesh: (as_it_is, root) if np.array_equal(mesh.vertices, body.vertices) else (4.0, np.eye(3)),
    )
    monkeypatch.setattr(module, "SURELY_READ", 3.0)
    found = module.stands(lively("parts"), body)
    assert np.array_equal(found.matrix, np.eye(3)) == stays
    assert found.rest_error == (as_it_is if stays else 4.0) and (found.root is root) == stays


@pytest.mark.parametrize(
    ("misfit", "behind", "aside", "surely", "surface", "asked"),
    [
        (0.001, 0.0016, 8, True, [0, 0], True),  # no doubt, so that its surface is not read
        (0.001, 0.0014, 8, True, [0, 0], False),
        (0.001, 0.0016, 12, True, [0, 0], False),
        (0.003, 0.0060, 0, True, [0, 0], False),
        (0.001, 0.0016, 12, False, [0, 0], True),
        (0.001, 0.0016, 12, True, [12, 0], True),
        (0.001, 0.0016, 12, True, [0, 15], True),
    ],
)
def test_a_body_in_doubt_whose_surface_is_surely_read_upright_and_ahead_is_asked_for_no_other_way(
    monkeypatch: pytest.MonkeyPatch,
    misfit: float,
    behind: float,
    aside: float,
    surely: bool,
    surface: list[float],
    asked: bool,
) -> None:
    root, read = Rotation.from_euler("y", aside, degrees=True).as_matrix()[None], list[int]()

    def understood(meshes: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        read.append(len(meshes))  # from behind after as it is
        return np.array([misfit if len(read) == 1 else behind]), root

    of_surface = Rotation.from_euler("YX", surface, degrees=True).as_matrix()
    others = list[object]()
    monkeypatch.setattr(module, "understanding_of", lambda _: understood)
    monkeypatch.setattr(module, "_read", lambda *_: (module.SURELY_READ if surely else 6.0, of_surface))
    monkeypatch.setattr(module, "_found", lambda _, seen: others.append(seen.root) or seen.stands)
    found = module.stands(lively("parts"), Mesh(BODY, np.empty((0, 3), np.int64)))
    assert np.array_equal(found.matrix, np.eye(3)) and bool(others) == asked
    assert np.isnan(found.rest_error) == (aside == 8 and behind > 1.5 * misfit)
    assert read == ([1, 1] if aside == 8 else [1]) and all(np.array_equal(each, root[0]) for each in others), (
        "what was seen is handed on"
    )
