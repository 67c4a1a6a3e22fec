"""Frames pass one by one: where each stands, how they are smoothed, and how little of them is held."""

import tracemalloc

import numpy as np
import pytest
import torch
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from datagen.common.errors import MeshError
from datagen.mesh.geometry import Mesh, bounding_box, standing_point
from tests.support.three_networks import lively
from training.inference.orientation import UPRIGHT, Axes
from training.inference.smoothing import smoothed
from training.inference.transfer import PoseTransfer, placed, scale_of
from training.networks import NETWORKS
from training.networks.parts import Parts

FACES = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4]])


class Copier(nn.Module):
    """Returns the source's vertices, as if source and target had one identity."""

    def forward(self, *, source: Tensor, target: Tensor) -> Tensor:
        return source


@pytest.fixture
def transfer() -> PoseTransfer:
    torch.manual_seed(0)
    return PoseTransfer(NETWORKS["dsffnet"](encoder_widths=(8, 16, 32), decoder_widths=(16, 32, 16)))


def mesh_of(seed: int, count: int = 40) -> Mesh:
    random = np.random.default_rng(seed)
    vertices, some = random.normal(size=(count, 3)) * (1, 2, 0.7), random.integers(0, count, (60, 3))
    return Mesh(vertices, np.concatenate([some, np.arange(count)[:, None] + np.arange(3)]) % count)


def test_a_sequence_of_one_is_a_call(transfer: PoseTransfer) -> None:
    source, target = mesh_of(1), mesh_of(2)
    (only,) = transfer.sequence([source], target, smooth=9)
    assert np.array_equal(only.vertices, transfer(source=source, target=target).vertices)


def test_frames_may_have_more_vertices_though_the_same_faces_and_stand_otherwise() -> None:
    transfer = PoseTransfer(lively("parts"))
    small, target = mesh_of(1), mesh_of(2)
    larger = Mesh(np.concatenate([small.vertices, small.vertices[:5] * 0.9]), small.faces)
    axes = Axes("Z", "-Y")
    upright = list(transfer.sequence([small, larger], target, source_axes=UPRIGHT, target_axes=UPRIGHT))
    lying = [Mesh(axes.restored(mesh.vertices), mesh.faces) for mesh in (small, larger)]
    again = transfer.sequence(lying, target, source_axes=axes, target_axes=UPRIGHT)
    for one, other in zip(upright, again, strict=True):
        np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-4)


def sized(target: Mesh, output: np.ndarray) -> np.ndarray:
    """An output at the target's size and place."""
    return placed(target, scale_of(target, output) * output)


def test_a_target_is_read_once_for_all_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    transfer, reads = PoseTransfer(lively("parts")), []
    read_target = Parts.read_target
    monkeypatch.setattr(Parts, "read_target", lambda *given, **told: reads.append(given) or read_target(*given, **told))
    monkeypatch.setattr(transfer, "_turned_round", lambda vertices, before: np.eye(3))
    sources, target = [mesh_of(1), mesh_of(3), mesh_of(4, 50)], mesh_of(2)
    frames = list(transfer.sequence(sources, target, source_axes=UPRIGHT, target_axes=UPRIGHT))
    assert len(reads) == 1
    for frame, source in zip(frames, sources, strict=True):
        moved = frame.vertices - sized(target, transfer.unplaced(source, target))
        np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-6)  # the way through space


def test_what_is_near_among_points_is_found_for_each_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Faces of the first vertex alone: all others are points, of other places in each frame."""
    transfer, random = PoseTransfer(lively("parts")), np.random.default_rng(0)
    monkeypatch.setattr(transfer, "_turned_round", lambda vertices, before: np.eye(3))
    clouds = [Mesh(random.normal(size=(300, 3)) * (0.1, 1, 0.1), np.zeros((1, 3), np.int64)) for _ in range(2)]
    frames = list(transfer.sequence(clouds, mesh_of(2), source_axes=UPRIGHT, target_axes=UPRIGHT))
    moved = frames[1].vertices - sized(mesh_of(2), transfer.unplaced(clouds[1], mesh_of(2)))
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-6)


def test_the_output_stands_on_the_ground_of_the_target() -> None:
    target = Mesh(np.array([[5.0, 3, 1], [6, 3, 1], [5, 5, 1], [6, 5, 1], [5, 5, 2]]), FACES)
    sitting = Mesh(target.vertices * (1, 0.4, 1), FACES)
    posed = PoseTransfer(Copier())(source=sitting, target=target)
    assert np.allclose(standing_point(posed.vertices), standing_point(target.vertices))
    assert bounding_box(posed.vertices).centre[1] < bounding_box(target.vertices).centre[1] - 0.3


def test_the_way_through_space_is_kept_at_the_size_of_the_target() -> None:
    """The target is the source's body, three times as large: its steps are three times as long."""
    body = mesh_of(3)
    steps = np.array([[0, 0, 0], [0.5, 0, 0], [1, 0.7, 0.2]])
    target = Mesh(body.vertices * 3 + 10, body.faces)
    posed = PoseTransfer(Copier()).sequence([Mesh(body.vertices + step, body.faces) for step in steps], target)
    for step, frame in zip(steps, posed, strict=True):
        assert np.allclose(frame.vertices, target.vertices + 3 * step, atol=1e-5)


def test_a_source_that_leans_is_read_upright_and_leans_in_the_output_and_a_target_that_leans_does_not_matter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    body = mesh_of(3)
    body.vertices[:] -= body.vertices.mean(axis=0)
    lean = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    leaning = Mesh(body.vertices @ lean.T + 5, body.faces)
    seen = list[np.ndarray]()

    class Reader(nn.Module):
        def forward(self, *, source: Tensor, target: Tensor) -> Tensor:
            seen.extend([source[0].numpy(), target[0].numpy()])
            return source

    def turned(self: PoseTransfer, vertices: np.ndarray, before: np.ndarray) -> np.ndarray:
        return lean if np.allclose(vertices - vertices.mean(axis=0), body.vertices @ lean.T) else np.eye(3)

    monkeypatch.setattr(PoseTransfer, "_turned_round", turned)
    steps = np.array([[0, 0, 0], [0.5, 0, 0], [1, 0.7, 0.2]])
    transfer = PoseTransfer(Reader())
    frames = list(transfer.sequence([Mesh(leaning.vertices + step, body.faces) for step in steps], leaning))
    upright = bounding_box(body.vertices).normalise(body.vertices)
    for source, target in zip(seen[::2], seen[1::2], strict=True):
        np.testing.assert_allclose(source, upright, atol=1e-5)
        np.testing.assert_allclose(target, upright, atol=1e-5)
    for step, frame in zip(steps, frames, strict=True):  # the source's own body: it leans as it did, as far away
        np.testing.assert_allclose(frame.vertices, leaning.vertices + step, atol=1e-4)


def test_meshes_that_stand_otherwise_come_back_in_their_own_axes(transfer: PoseTransfer) -> None:
    source, target, of_source, of_target = mesh_of(1), mesh_of(2), Axes("Z", "-Y"), Axes("-X", "Y")
    expected = transfer(source=source, target=target)
    turned = {"source": Mesh(of_source.restored(source.vertices), source.faces),
              "target": Mesh(of_target.restored(target.vertices), target.faces)}  # fmt: skip
    found = transfer(**turned, source_axes=of_source, target_axes=of_target)
    assert np.allclose(found.vertices, of_target.restored(expected.vertices), atol=1e-5)


def test_refining_changes_the_output_and_nothing_else(transfer: PoseTransfer) -> None:
    source, target = mesh_of(1), mesh_of(2)
    plain, refined = transfer(source=source, target=target), transfer(source=source, target=target, refine=4.0)
    assert abs(plain.vertices - refined.vertices).max() > 1e-3 and np.array_equal(refined.faces, target.faces)


@pytest.mark.parametrize("network", ["parts", "dsffnet"])
@pytest.mark.parametrize("first", [True, False])
def test_vertices_in_no_face_change_nothing_and_move_as_the_nearest_one_does(network: str, *, first: bool) -> None:
    transfer = PoseTransfer(lively(network))

    def with_loose(mesh: Mesh, places: np.ndarray) -> Mesh:
        vertices = [places, mesh.vertices] if first else [mesh.vertices, places]
        return Mesh(np.concatenate(vertices), mesh.faces + len(places) * first)

    source, target = mesh_of(1), mesh_of(2)
    plain = transfer(source=source, target=target, refine=1.0)
    beside = target.vertices[7] + (0, -0.01, 0)
    whole = with_loose(target, np.array([beside, beside]))
    found = transfer(source=with_loose(source, np.array([[0, 90.0, 0]])), target=whole, refine=1.0)
    own, loose = (found.vertices[2:], found.vertices[:2]) if first else (found.vertices[:-2], found.vertices[-2:])
    np.testing.assert_array_equal(own, plain.vertices)
    np.testing.assert_allclose(loose - beside, np.broadcast_to(plain.vertices[7] - target.vertices[7], (2, 3)))
    assert np.array_equal(found.faces, whole.faces)


def test_a_broken_frame_is_named(transfer: PoseTransfer) -> None:
    broken = Mesh(np.full((4, 3), np.nan), FACES[:1])
    frames = transfer.sequence([mesh_of(1), broken], mesh_of(2))
    next(frames)
    with pytest.raises(MeshError, match="source 1"):
        next(frames)


def test_a_mesh_that_comes_back_has_no_error_onto_itself() -> None:
    meshes = np.random.default_rng(0).uniform(-1, 1, (5, 30, 3))
    assert np.allclose(PoseTransfer(Copier()).self_errors(meshes), 0)


class TestSmoothing:
    """As scipy.signal.savgol_filter over the whole sequence, from a window of it."""

    @pytest.mark.parametrize("count", [5, 6, 7, 30])
    def test_it_is_the_filter_over_the_whole_sequence(self, count: int) -> None:
        frames = np.random.default_rng(0).normal(size=(count, 4, 3))
        found = np.stack(list(smoothed(iter(frames), 5)))
        assert np.allclose(found, savgol_filter(frames, 5, 2, axis=0, mode="interp"))

    @pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 6])
    def test_a_sequence_shorter_than_the_window_is_smoothed_over_its_length(self, count: int) -> None:
        time = np.linspace(0, 1, count)[:, None, None]
        arc = np.concatenate([time, time**2, 1 - time], axis=-1)
        found = list(smoothed(iter(arc), 9))
        assert len(found) == count and all(np.allclose(*pair) for pair in zip(found, arc, strict=True))

    def test_a_swinging_limb_keeps_its_length_and_loses_its_jitter(self) -> None:
        angle = np.linspace(0, 2, 60)
        clean = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)[:, None]
        jitter = np.random.default_rng(0).normal(0, 0.02, clean.shape)
        found = np.stack(list(smoothed(iter(clean + jitter), 11)))
        assert abs(np.stack(list(smoothed(iter(clean), 11))) - clean).max() < 1e-3
        assert np.std(np.diff(found - clean, axis=0)) < 0.35 * np.std(np.diff(jitter, axis=0))

    @pytest.mark.parametrize("window", [0, 1, 3])
    def test_a_small_window_smooths_nothing(self, window: int) -> None:
        frames = np.random.default_rng(0).normal(size=(6, 4, 3))
        assert np.array_equal(np.stack(list(smoothed(iter(frames), window))), frames)


def test_a_hundred_frames_take_no_more_memory_than_ten() -> None:
    target = mesh_of(2, count=3000)

    def peak(count: int) -> int:
        random = np.random.default_rng(0)
        frames = (Mesh(random.normal(size=(3000, 3)), target.faces) for _ in range(count))
        tracemalloc.start()
        try:
            for _ in PoseTransfer(Copier()).sequence(frames, target, smooth=5):
                pass
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(2)
    assert peak(100) < peak(10) + 10 * target.vertices.nbytes
