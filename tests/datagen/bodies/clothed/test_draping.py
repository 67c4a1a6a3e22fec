"""Cloth by itself, where one knows what it has to do."""

import hashlib

import numpy as np
import pytest

from datagen.bodies.clothed.draping import Cloth, Path, depths, require_outside
from datagen.bodies.clothed.garments import Garment
from datagen.bodies.clothed.model import DRAPING
from datagen.bodies.skinning import Rest
from datagen.common.errors import BodyError
from datagen.recipe import DrapeSolver

SIDE = 12
STILL = np.tile(np.eye(3, 4), (3, 1, 1, 1))


def cloth(places: np.ndarray, pinned: np.ndarray, bending: float = 0.25) -> Garment:
    corners = np.array([SIDE * x + y for x in range(SIDE - 1) for y in range(SIDE - 1)])
    faces = np.concatenate([np.stack([corners, corners + SIDE, corners + 1], axis=1),
                            np.stack([corners + SIDE, corners + SIDE + 1, corners + 1], axis=1)])  # fmt: skip
    count = len(places)
    return Garment(
        rest=Rest(places, np.zeros((1, 3)), np.ones((count, 1)), (-1,)), faces=faces, shown=np.arange(count),
        shown_faces=faces, part=np.ones(count, np.int64), pinned=pinned, distance=np.full(count, 0.005),
        bending=np.full(count, bending), roomy=np.zeros(count, bool), uneased=places,
    )  # fmt: skip


def square(y: float) -> np.ndarray:
    """Vertices [144, 3] of half a metre of cloth, level at height y."""
    line = np.linspace(-0.25, 0.25, SIDE)
    return np.array([(x, y, z) for x in line for z in line])


def ball(radius: float = 0.15) -> tuple[np.ndarray, np.ndarray]:
    rings, around = 24, 32
    angles = np.linspace(0, np.pi, rings)[:, None], np.arange(around) * 2 * np.pi / around
    places = np.stack(
        [
            np.sin(angles[0]) * np.cos(angles[1]),
            np.cos(angles[0]) + 0 * angles[1],
            np.sin(angles[0]) * np.sin(angles[1]),
        ],
        axis=2,
    )
    number = np.arange(rings * around).reshape(rings, around)
    a, b = number[:-1], np.roll(number, -1, axis=1)[:-1]
    c, d = np.roll(number, -1, axis=1)[1:], number[1:]
    faces = np.concatenate([np.stack([a, b, c], 2).reshape(-1, 3), np.stack([a, c, d], 2).reshape(-1, 3)])
    return (radius * places.reshape(-1, 3)).astype(np.float32), faces


def worn_by(places: np.ndarray) -> Rest:
    return Rest(places.astype(float), np.zeros((1, 3)), np.ones((len(places), 1)), (-1,))


def drape(garment: Garment, **solver: int) -> np.ndarray:
    places, faces = ball()
    path = Path(np.stack([places] * 3), STILL, garment.rest.vertices.astype(np.float32))
    return Cloth(garment, worn_by(places), faces).drape(path, DrapeSolver(frames=2, substeps=1, **solver))


def test_cloth_that_falls_on_a_ball_lies_on_it_and_hangs_beside_it() -> None:
    draped = drape(cloth(square(0.16), np.zeros(SIDE**2, bool)), settle=400)
    assert np.isfinite(draped).all() and depths(draped, *ball()).max() < -0.003
    middle = np.abs(draped[:, [0, 2]]).max(axis=1) < 0.05
    assert draped[middle, 1].min() > 0.1 and draped[:, 1].min() < 0.05


def test_cloth_that_hangs_by_an_edge_hangs_down_as_long_as_it_is() -> None:
    """Half a metre of it, stretched by its weight by less than 2 %."""
    upright = square(0.0)[:, [0, 2, 1]] + [0, 0.5, 0.3]
    top = upright[:, 1] > upright[:, 1].max() - 1e-9
    draped = drape(cloth(upright, top), settle=400)
    length = draped[top, 1].mean() - draped[upright[:, 1] < 0.2501, 1].mean()
    assert 0.499 < length < 0.51
    assert np.abs(draped[top] - upright[top]).max() < 1e-5, "what is pinned stays on the ball"


def test_fine_cloth_is_not_stretched_by_its_weight_after_a_few_steps() -> None:
    """Nowhere further from its pins than cloth reaches, where steps alone would let it sag."""
    upright = square(0.0)[:, [0, 2, 1]] * 0.2 + [0, 0.5, 0.3]
    top = upright[:, 1] > upright[:, 1].max() - 1e-9
    draped = drape(cloth(upright, top), settle=60)
    assert draped[top, 1].mean() - draped[:, 1].min() < 1.0005 * np.ptp(upright[:, 1])


def test_stiff_cloth_stands_out_where_soft_cloth_hangs_down() -> None:
    """Held by two rows at one side, over the ball."""
    level = square(0.5)
    held = level[:, 0] < -0.2
    soft, stiff = (drape(cloth(level, held, bending), settle=240)[~held, 1].mean() for bending in (0.15, 0.6))
    assert soft < stiff - 0.005


def test_a_pose_does_not_depend_on_the_one_before_it() -> None:
    places, faces = ball()
    garment = cloth(square(0.16), np.zeros(SIDE**2, bool))
    ready, solver = Cloth(garment, worn_by(places), faces), DrapeSolver(frames=2, substeps=2, settle=30)
    still, moved = (
        Path(np.stack([places, places, places + shift]).astype(np.float32), STILL, square(0.16).astype(np.float32))
        for shift in (0, 0.05)
    )
    first = ready.drape(still, solver)
    other = ready.drape(moved, solver)
    assert not np.array_equal(first, other) and np.array_equal(first, ready.drape(still, solver))


def test_the_bytes_are_those_of_this_version_on_every_machine() -> None:
    """Over a cube of exact numbers. Other bytes need another version of ``DRAPING``, and that another line here."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 8
    faces = np.array([(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6),
                      (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)])  # fmt: skip
    line = np.arange(SIDE) / 32 - 0.171875
    level = np.array([(x, 0.15625, z) for x in line for z in line])
    path = Path(np.stack([corners.astype(np.float32)] * 3), STILL, level.astype(np.float32))
    ready = Cloth(cloth(level, np.zeros(SIDE**2, bool)), worn_by(corners), faces)
    draped = ready.drape(path, DrapeSolver(frames=2, substeps=2, settle=60))
    assert np.ptp(draped[:, 1]) > 0.05
    assert hashlib.sha256(draped.tobytes()).hexdigest()[:16] == {"7": "744df98c07e0a0ce"}[DRAPING.version]


def test_a_garment_within_the_body_is_refused() -> None:
    places, faces = ball()
    with pytest.raises(BodyError, match=r"vertices of it are more than 10 mm inside of the body at rest.*larger ease"):
        require_outside(cloth(0.1 * square(0.0), np.zeros(SIDE**2, bool)), worn_by(places), faces, name="it")
