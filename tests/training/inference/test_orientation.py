"""A mesh is turned into the training data's axes and back, and how it stands is found by what the network returns."""

import numpy as np
import pytest
from numpy.typing import NDArray

from datagen.common.errors import RecipeError
from training.inference.orientation import (
    EVERY_AXES,
    UPRIGHT,
    Axes,
    Orientation,
    axes_as_options,
    axes_of_both,
    orientation,
)

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
    assert found.axes == axes and found.error(axes) < 1e-12 and found.is_certain
    assert [other for other in EVERY_AXES if found.fits(other)] == [axes]


def about_the_vertical(mesh: NDArray[np.floating], degrees: float) -> NDArray[np.floating]:
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    return mesh @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])


@pytest.mark.parametrize("quarter", [0, 90, 180, 270])
@pytest.mark.parametrize("degrees", [-45, -30, -20, 20, 30, 45])
def test_of_a_body_between_the_axes_nothing_is_certain(quarter: int, degrees: int) -> None:
    turned = about_the_vertical(BODY, quarter + degrees)
    found = orientation(errors_of_a_network_that_knows_one_body, [turned])
    assert found.is_between and not found.is_certain and not found.fits(UPRIGHT)
    assert found.axes == UPRIGHT, "it is left as it is"


def ways(least: float, others: float, *, best: int = 5, turned: float = 1.0) -> Orientation:
    return Orientation(np.where(np.arange(24) == best, least, others), np.array([1.0, turned]))


def test_a_way_is_certain_where_it_is_good_clearly_the_best_and_not_between_two() -> None:
    assert ways(0.005, 0.05).axes == EVERY_AXES[5] and ways(0.005, 0.0076).is_certain
    assert ways(0.005, 0.0074).axes == UPRIGHT, "others are nearly as good"
    assert ways(0.011, 0.5).axes == UPRIGHT, "it comes back as another shape: an animal, by a network of humans"
    assert ways(0.005, 0.05, turned=0.0059).axes == UPRIGHT, "it is nearly as good when it is turned further"
    assert ways(0.005, 0.006).fits(UPRIGHT) and not ways(0.005, 0.05).fits(UPRIGHT)
    assert ways(0.001, 0.05, best=0, turned=0.0008).fits(UPRIGHT), "not certain, and nothing speaks against it"
    assert not ways(0.001, 0.05, best=0, turned=0.0006).fits(UPRIGHT)


def test_frames_vote() -> None:
    """One frame of three is misjudged; the others outvote it."""
    votes = iter([*(np.eye(24)[[0, 3, 3]] * -0.009 + 0.01), *np.ones((3, 2))])
    assert orientation(lambda meshes: next(votes), [BODY] * 3).axes == EVERY_AXES[3]


def test_no_more_than_256_vertices_are_looked_at_in_the_box_of_all() -> None:
    looked_at: list[NDArray[np.floating]] = []
    mesh = np.random.default_rng(1).uniform(size=(5000, 3))
    orientation(lambda meshes: looked_at.append(meshes) or np.ones(len(meshes)), [mesh])
    assert looked_at[0].shape == (24, 256, 3) and abs(looked_at[0]).max() <= 1
    middle, half = (mesh.min(0) + mesh.max(0)) / 2, np.ptp(mesh, axis=0).max() / 2
    assert np.allclose(looked_at[0][0, 0], (mesh[0] - middle) / half)


def test_axes_of_one_or_both_meshes_by_hand() -> None:
    assert axes_of_both("z", "-y") == (Axes("Z", "-Y"), Axes("Z", "-Y"))
    assert axes_of_both("Z,Y", "-Y,Z") == axes_of_both("Z,Y", None) == (Axes("Z", "-Y"), UPRIGHT)
    assert axes_of_both(None, None) == (UPRIGHT, UPRIGHT) and axes_of_both(None, "X")[0] == Axes("Y", "X")


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
