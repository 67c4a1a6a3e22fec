"""Where the bodies stand in the window: all of them are seen, and above the controls where these lie over it."""

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from datagen.mesh.geometry import Mesh
from workflows.demo.stage import ROLES, Stage

BOX = np.array([[x, y, z] for x in (-0.4, 0.4) for y in (0, 1.7) for z in (-0.1, 0.1)])


def seen(width: int, height: int) -> np.ndarray[Any, Any]:
    """Where corners of the bodies' boxes are seen [corner, 2]: 0 to 1, from the left and from above."""
    client = MagicMock()
    client.camera = camera = SimpleNamespace(
        aspect=width / height, image_width=width, on_update=lambda _: None, position=(0, 0, 1), look_at=(0, 0, 0)
    )
    client.scene.add_frame = lambda *_, **__: SimpleNamespace(position=np.zeros(3))
    stage = Stage(client)
    for role in ROLES:
        stage.show(role, Mesh(BOX, np.array([[0, 1, 2]])), unit=1.7)
    stage.arrange()
    corners = np.concatenate(
        [BOX - [0, BOX[:, 1].min(), 0] + np.array(its.node.position) for its in stage._shown.values()]
    )
    away = np.array(camera.position) - np.array(camera.look_at)
    back = away / np.linalg.norm(away)
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    local = (corners - np.array(camera.position)) @ np.stack([right, np.cross(back, right), back]).T
    flat = local[:, :2] / -local[:, 2:] / np.tan(camera.fov / 2)
    return np.stack([0.5 + flat[:, 0] / camera.aspect / 2, 0.5 - flat[:, 1] / 2], axis=1)


def test_bodies_that_are_taken_away_are_shown_again() -> None:
    client = MagicMock()
    stage = Stage(client)
    mesh = Mesh(BOX, np.array([[0, 1, 2]]))
    for _ in range(2):
        for role in ROLES:
            stage.show(role, mesh, unit=1.7)
        bodies = [its.body for its in stage._shown.values()]
        stage.say("output", "PMD")
        stage.clear()
        assert all(its.body is None for its in stage._shown.values())
        assert stage._shown["output"].label.text == ROLES["output"]
    assert client.scene.add_mesh_simple.call_count == 2 * len(ROLES)
    assert bodies[0].remove.call_count == 2 * len(ROLES)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("width", "height", "lowest"),
    [(1100, 900, 1.0), (480, 800, 0.4), (360, 640, 0.4), (780, 1600, 0.4), (540, 400, 0.4), (568, 320, 0.4)],
)
def test_all_bodies_are_seen_above_the_controls(width: int, height: int, lowest: float) -> None:
    places = seen(width, height)
    assert places[:, 0].min() > 0 and places[:, 0].max() < 1
    assert places[:, 1].min() > 0 and places[:, 1].max() < lowest
    assert np.ptp(places, axis=0).max() > 0.6 * lowest  # and they are not lost in it
