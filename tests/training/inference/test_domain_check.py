"""What a person is told about a mesh that its network has not met, and that nothing is said of one that it has."""

import json
from pathlib import Path

import numpy as np
import pytest

from datagen.generate import generate
from datagen.mesh.geometry import Mesh
from tests.support.recipes import tiny_dataset, tiny_training
from training.inference.domain_check import Seen, Tears, noted, part_sizes, remarks, seen_by
from training.inference.orientation import EVERY_AXES, UPRIGHT, Axes, Orientation
from training.inference.standing import Standing
from workflows.pipeline.train import write_head

GRID = np.stack(np.meshgrid(np.linspace(0, 1, 8), np.linspace(0, 2, 15), [0.0, 0.4], indexing="ij"), -1).reshape(-1, 3)
STRIP = np.stack([np.arange(238), np.arange(1, 239), np.arange(2, 240)], axis=1)
BODY = Mesh(GRID, STRIP)
SEEN = Seen((200, 300), np.array([0.4, 0.9, 0.1]), np.array([0.8, 1.0, 0.3]))


def best_in(axes: Axes, *, least: float = 0.001, turned: float = 0.05) -> Orientation:
    return Orientation(np.where([each == axes for each in EVERY_AXES], least, 0.05), np.full(2, turned))


GOOD, NEVER = best_in(UPRIGHT), best_in(UPRIGHT, least=0.04)


def told(
    mesh: Mesh,
    *,
    way: Orientation = GOOD,
    axes: Axes = UPRIGHT,
    by_hand: bool = False,
    seen: Seen | None = SEEN,
) -> str:
    both = UPRIGHT, way.axes
    return "\n".join(remarks(mesh, name="A", axes=axes, way=way, both=both, stated=by_hand, seen=seen))


@pytest.mark.parametrize("seen", [SEEN, None])
def test_nothing_is_said_of_a_mesh_as_in_training(seen: Seen | None) -> None:
    assert told(BODY, seen=seen) == ""


LYING = Axes("Z", "-Y")


def test_a_mesh_that_certainly_stands_otherwise_is_told_how_to_be_turned() -> None:
    found = told(BODY, way=best_in(LYING))
    assert "A seems to stand Z up, facing -Y" in found and found.endswith("--align, or --up=Y,Z --front=Z,-Y")
    assert "box" not in told(Mesh(GRID * (4, 1, 1), STRIP), way=best_in(LYING)), "its box is not that of the turned"
    assert told(BODY, way=best_in(LYING), axes=LYING, seen=None) == "", "--align has turned it"


@pytest.mark.parametrize(
    ("way", "says"),
    [
        (NEVER, "comes back from the network as another shape (PMD 0.040 onto itself): it is unlike the bodies"),
        (best_in(LYING, least=0.04), "another shape (PMD 0.050 onto itself): it is unlike the bodies of training, or"),
        (best_in(LYING, turned=0.0009), "or does not stand Y up, facing Z, or is turned about the vertical"),
        (best_in(UPRIGHT, turned=0.0005), "A may be turned about the vertical: it comes back from the network better"),
        (Orientation(np.linspace(0.008, 0.006, 24), np.ones(2)), "A may not stand Y up, facing Z: it comes back"),
    ],
)
def test_of_what_is_not_certain_no_way_of_standing_is_named(way: Orientation, says: str) -> None:
    found = told(BODY, way=way)
    assert says in found and "The result may be poor" in found and len(found.splitlines()) == 1
    assert "seems to stand" not in found and "--align" not in found and "--up" not in found


def test_who_says_how_a_mesh_stands_is_contradicted_only_where_it_comes_back_as_another_shape() -> None:
    assert told(BODY, way=best_in(LYING), axes=LYING, by_hand=True, seen=None) == ""
    assert told(BODY, way=best_in(LYING, turned=0.0009), axes=LYING, by_hand=True, seen=None) == ""
    assert "does not stand Y up" in told(BODY, way=best_in(LYING), by_hand=True)


def test_parts_are_counted_over_seams() -> None:
    doubled = Mesh(np.concatenate([GRID, GRID[:3], GRID + 5]), np.concatenate([STRIP, [[240, 241, 242]]]))
    sizes = part_sizes(doubled)
    assert sizes[0] == 240 and sizes[1:].tolist() == [1] * 240


def test_two_bodies_in_one_file() -> None:
    vertices = np.concatenate([GRID, GRID + 3, GRID - 3])
    three = Mesh(vertices, np.concatenate([STRIP, STRIP + 240, STRIP + 480]))
    assert "A has 3 separate parts, the largest with 33% of the vertices" in told(three, seen=None)
    two = Mesh(vertices[:480], three.faces[: 2 * len(STRIP)])
    assert "A has 2 separate parts, the largest with 50% of the vertices" in told(two, seen=None)


def test_a_stray_vertex_and_a_lost_axis() -> None:
    stray = np.concatenate([GRID, [[0, 90.0, 0]]])
    assert "A has 1 vertex far from all others" in told(Mesh(stray, STRIP), seen=None)
    assert "A is nearly flat" in told(Mesh(GRID * (1, 1, 1e-4), STRIP))


def test_proportions_and_vertex_counts_beyond_training() -> None:
    assert "box of 1.00 x 0.50 x 0.10" in told(Mesh(GRID * (4, 1, 1), STRIP))
    assert "A has 240 vertices, training saw 5,000" in told(BODY, seen=Seen((5000, 5000), SEEN.least, SEEN.most))


def test_what_a_run_noted_needs_no_dataset(tmp_path: Path) -> None:
    checkpoint = tmp_path / "run" / "checkpoints" / "step-00000004"
    checkpoint.mkdir(parents=True)
    about = {"dataset": {"url": str(tmp_path / "gone.zarr")}, "seen": noted(SEEN)}
    (tmp_path / "run" / "provenance.json").write_text(json.dumps(about))
    seen = seen_by(checkpoint)
    assert seen is not None and seen.vertices == SEEN.vertices
    assert seen.least.tolist() == list(SEEN.least) and seen.most.tolist() == list(SEEN.most)
    (tmp_path / "run" / "provenance.json").write_text(json.dumps(about | {"seen": {"vertices": 3}}))
    assert seen_by(checkpoint) is None, "half a note is none, and no traceback"
    assert seen_by(tmp_path / "elsewhere" / "weights.safetensors") is None


def test_a_training_notes_its_bodies_such_that_none_of_them_is_warned_of(tmp_path: Path) -> None:
    dataset = generate(tiny_dataset(), str(tmp_path / "leg.zarr"))
    write_head(tiny_training(), dataset, tmp_path / "run")
    seen = seen_by(tmp_path / "run" / "checkpoints" / "step-00000001")
    assert seen is not None and seen.vertices == (32, 32)
    for who in dataset.identities("training"):
        for vertices in dataset.vertices(who, dataset.grid.poses_of(who)):
            shape = np.ptp(vertices, axis=0) / np.ptp(vertices, axis=0).max()
            assert (seen.least <= shape + 1e-6).all() and (shape <= seen.most + 1e-6).all()


@pytest.mark.parametrize(("error", "is_said"), [(4.0, False), (20.0, True), (np.nan, True)])
def test_parts_that_do_not_touch_are_no_matter_where_the_whole_is_understood(error: float, is_said: bool) -> None:
    """Clothes, hair and eyes are geometries of their own; three people are no body that a network understands."""
    several = Mesh(
        np.concatenate([GRID + 3 * number for number in range(3)]),
        np.concatenate([STRIP + len(GRID) * number for number in range(3)]),
    )
    standing = Standing(np.eye(3), 0.001, error)
    said = list(remarks(several, name="A", axes=standing, way=None, both=None, stated=False, seen=None))
    assert any("separate parts" in line and "--target-geometry" in line for line in said) == is_said


@pytest.mark.parametrize(
    ("count", "saw", "is_said"), [(8, None, True), (71, None, True), (72, None, False), (32, (32, 32), False)]
)
def test_too_few_vertices_are_no_body_however_well_they_fit(
    count: int, saw: tuple[int, int] | None, is_said: bool
) -> None:
    """Of a box's eight corners a network makes of each what it likes."""
    places = np.random.default_rng(0).normal(size=(count, 3))
    mesh = Mesh(np.concatenate([places, places]), np.array([[0, 1, 2]]))  # of a box in a file each corner is three
    seen = Seen(saw, np.zeros(3), np.ones(3)) if saw else None
    standing = Standing(np.eye(3), 0.0001, 1.0)
    said = list(remarks(mesh, name="A", axes=standing, way=None, both=None, stated=False, seen=seen))
    assert any(f"A has {count} vertices, too few to show how a body stands" in line for line in said) == is_said


@pytest.mark.parametrize(
    ("away", "size", "is_torn"), [(0.0, 1.0, False), (0.2, 1.0, False), (0.6, 1.0, True), (0.6, 300.0, True)]
)
def test_a_surface_is_torn_where_edges_are_pulled_across_the_body(away: float, size: float, is_torn: bool) -> None:
    """Long ones of a coarse mesh, and short ones that grow to a tenth of it, are none."""
    rows, columns = np.divmod(np.arange(22), 2)
    vertices = size * np.stack([columns, rows / 10, 0 * rows], axis=1).astype(np.float64)
    first = np.arange(0, 20, 2)
    faces = np.concatenate([np.stack([first, first + 1, first + 2], 1), np.stack([first + 1, first + 3, first + 2], 1)])
    posed = vertices + np.where(rows[:, None] > 5, [0, size * away, 0], 0)
    said = Tears(Mesh(vertices, faces)).in_output(Mesh(posed, faces), name="gown.obj")
    assert bool(said) == is_torn
    if is_torn:
        assert said.startswith("gown.obj comes out torn: 2 of its edges are more than 4 times as long, the longest 7")
