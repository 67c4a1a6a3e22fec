"""A mesh is turned into the training data's axes and back, and how it stands is found by what the network returns."""

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.errors import RecipeError
from training.alignment import EVERY_AXES, UPRIGHT, Axes, axes_as_options, axes_of_both, orientation

BODY = np.random.default_rng(0).normal(size=(60, 3)) * (1, 3, 0.5) + (0, 0, 0.2)


def errors_of_a_network_that_knows_one_body(meshes: NDArray[np.floating]) -> NDArray[np.float64]:
    """A network that answers every mesh with BODY as it stood in training."""
    low, high = BODY.min(axis=0), BODY.max(axis=0)
    known = (BODY - (low + high) / 2) / ((high - low).max() / 2)
    return np.square(meshes - known).mean(axis=(1, 2))


def test_there_are_24_ways_to_stand_and_none_mirrors() -> None:
    matrices = np.stack([axes.matrix for axes in EVERY_AXES])
    assert len(np.unique(matrices.reshape(24, 9), axis=0)) == 24
    assert np.allclose(np.linalg.det(matrices), 1)
    assert np.array_equal(matrices[0], np.eye(3))


def test_a_file_with_z_up_that_faces_minus_y_is_stood_up() -> None:
    head, nose = np.array([[0.0, 0, 2]]), np.array([[0.0, -1, 0]])
    axes = Axes("Z", "-Y")
    assert np.array_equal(axes.turned(head), [[0, 2, 0]]) and np.array_equal(axes.turned(nose), [[0, 0, 1]])


@pytest.mark.parametrize("axes", EVERY_AXES, ids=str)
def test_turning_and_restoring_cancel_and_the_way_of_standing_is_found(axes: Axes) -> None:
    stored = axes.restored(BODY)
    assert np.allclose(axes.turned(stored), BODY)
    found = orientation(errors_of_a_network_that_knows_one_body, [stored * 40 + 7])
    assert found.axes == axes and found.error(axes) < 1e-12
    assert found.is_unlike_training == (axes != UPRIGHT)


def test_without_a_clear_difference_a_mesh_is_left_as_it_stands() -> None:
    slightly = np.ones(24)
    slightly[5] = 0.9
    assert orientation(lambda meshes: slightly, [BODY]).axes == UPRIGHT


def test_frames_vote() -> None:
    """One frame of three is misjudged; the others outvote it."""
    votes = iter(np.eye(24)[[0, 3, 3]] * -0.9 + 1)
    assert orientation(lambda meshes: next(votes), [BODY] * 3).axes == EVERY_AXES[3]


def test_no_more_than_256_vertices_are_looked_at_in_the_box_of_all() -> None:
    looked_at: list[NDArray[np.floating]] = []
    mesh = np.random.default_rng(1).uniform(size=(5000, 3))
    orientation(lambda meshes: looked_at.append(meshes) or np.ones(24), [mesh])
    assert looked_at[0].shape == (24, 256, 3) and abs(looked_at[0]).max() <= 1
    middle, half = (mesh.min(0) + mesh.max(0)) / 2, np.ptp(mesh, axis=0).max() / 2
    assert np.allclose(looked_at[0][0, 0], (mesh[0] - middle) / half)


def test_axes_of_one_or_both_meshes_by_hand() -> None:
    assert axes_of_both("z", "-y") == (Axes("Z", "-Y"), Axes("Z", "-Y"))
    assert axes_of_both("Z,Y", "-Y,Z") == (Axes("Z", "-Y"), UPRIGHT)


@pytest.mark.parametrize(
    ("up", "front", "says"),
    [("W", "Z", "'W' is no axis"), ("Y", "-Y", "two different axes"), ("Y,Z,X", "Z", "one axis, or two")],
)
def test_axes_that_mean_nothing(up: str, front: str, says: str) -> None:
    with pytest.raises(RecipeError, match=says):
        axes_of_both(up, front)


@pytest.mark.parametrize("target", [Axes("Z", "-Y"), Axes("-X", "Y"), UPRIGHT])
def test_options_are_read_as_they_are_told(target: Axes) -> None:
    for source in (Axes("Z", "-Y"), UPRIGHT):
        up, front = (word.partition("=")[2] for word in axes_as_options(source, target).split())
        assert axes_of_both(up, front) == (source, target)
