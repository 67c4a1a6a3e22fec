"""Sequences: frames in their order, and one animated GLB."""

import json
import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from datagen.common.errors import MeshError, StorageError
from datagen.mesh.files import MeshFile, read_mesh_file, save_mesh
from datagen.mesh.formats import glb_writer as mesh_glb_written
from datagen.mesh.formats.gltf import Gltf
from datagen.mesh.geometry import Mesh
from datagen.mesh.sequences import frames_of, is_pattern, write_animation
from tests.support.shapes.mesh_files import PNG, golden, scene, sound


def shown(path: Path, seconds: float) -> list[tuple[NDArray[Any], NDArray[Any]]]:
    """World positions and local normals of each primitive at a time, as the glTF specification has them shown."""
    file = Gltf(path)
    (animation,) = file.json["animations"]
    (channel,) = animation["channels"]
    sampler = animation["samplers"][channel["sampler"]]
    assert channel["target"]["path"] == "weights"
    times, table = file.accessor(sampler["input"])[:, 0], file.accessor(sampler["output"])
    table = table.reshape(len(times), -1)
    weights = np.array([np.interp(seconds, times, column) for column in table.T])
    assert sampler["interpolation"] == "LINEAR"
    node = channel["target"]["node"]
    found = []
    for piece in file.json["meshes"][file.nodes[node]["mesh"]]["primitives"]:
        assert len(piece["targets"]) == len(weights) == len(file.json["meshes"][0]["weights"])
        values = []
        for name in ("POSITION", "NORMAL"):
            targets = [file.accessor(target[name]) for target in piece["targets"]]
            values.append(file.accessor(piece["attributes"][name]) + np.tensordot(weights, targets, 1))
        world = file.world[node]
        found.append((values[0] @ world[:3, :3].T + world[:3, 3], values[1]))
    return found


def moves(read: MeshFile, count: int) -> NDArray[np.float64]:
    swing = np.linspace(0, 1, count)[:, None, None] * np.random.default_rng(0).normal(size=read.mesh.vertices.shape)
    return read.mesh.vertices + swing


def test_each_frame_is_shown_at_its_time(tmp_path: Path) -> None:
    read = read_mesh_file(scene().save(tmp_path / "scene.glb"))
    frames = moves(read, 6)
    write_animation(read, frames, tmp_path / "moving.glb", frames_per_second=25)
    sound(tmp_path / "moving.glb")
    for number, frame in enumerate(frames):
        for positions, normals in shown(tmp_path / "moving.glb", number / 25 + (1e-7 if number else 0)):
            assert np.allclose(positions, frame, atol=1e-4)
            assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)
    between = shown(tmp_path / "moving.glb", 1.5 / 25)[0][0]
    assert np.allclose(between, (frames[1] + frames[2]) / 2, atol=1e-4)
    assert trimesh.load_scene(tmp_path / "moving.glb").geometry


def test_materials_and_texture_coordinates_of_an_obj_move_along(tmp_path: Path) -> None:
    read = read_mesh_file(golden("cube.obj", tmp_path))
    frames = moves(read, 3)
    write_animation(read, iter(frames), tmp_path / "moving.glb", frames_per_second=10)
    described = sound(tmp_path / "moving.glb")
    assert [material["name"] for material in described["materials"]] == ["skin", "cloth"]
    assert PNG in (tmp_path / "moving.glb").read_bytes() and described["nodes"][0]["name"] == "person"
    assert all("TEXCOORD_0" in piece["attributes"] for piece in described["meshes"][0]["primitives"])
    for positions, _ in shown(tmp_path / "moving.glb", 0.2):
        assert np.allclose(positions[:8], frames[2], atol=1e-5)
        assert {tuple(row) for row in np.round(positions, 4)} == {tuple(row) for row in np.round(positions[:8], 4)}


def test_bounds_of_morph_targets_are_stated(tmp_path: Path) -> None:
    read = read_mesh_file(scene().save(tmp_path / "scene.glb"))
    write_animation(read, moves(read, 3), tmp_path / "moving.glb", frames_per_second=10)
    described = sound(tmp_path / "moving.glb")
    for target in described["meshes"][0]["primitives"][0]["targets"]:
        values = Gltf(tmp_path / "moving.glb").accessor(target["POSITION"])
        accessor = described["accessors"][target["POSITION"]]
        assert np.allclose(accessor["min"], values.min(axis=0)) and np.allclose(accessor["max"], values.max(axis=0))


def test_memory_does_not_grow_with_frames(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(4)
    save_mesh(Mesh(ball.vertices, ball.faces), tmp_path / "ball.ply")
    read = read_mesh_file(tmp_path / "ball.ply")

    def peak(count: int) -> int:
        tracemalloc.start()
        frames = (read.mesh.vertices * (1 + number / count) for number in range(count))
        write_animation(read, frames, tmp_path / "moving.glb", frames_per_second=30)
        highest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return highest

    peak(3)
    grown = peak(60) - peak(10)
    assert grown < 50 * len(ball.vertices) * 24 / 4  # the frames themselves have four times that
    content = (tmp_path / "moving.glb").stat().st_size
    assert content < 1.2 * 60 * len(ball.vertices) * 24 + 200_000


def test_one_frame_is_a_still(tmp_path: Path) -> None:
    read = read_mesh_file(golden("cube.obj", tmp_path))
    write_animation(read, moves(read, 1), tmp_path / "still.glb", frames_per_second=10)
    assert "animations" not in sound(tmp_path / "still.glb")
    assert np.allclose(read_mesh_file(tmp_path / "still.glb").mesh.vertices[:8], read.mesh.vertices)


def test_what_cannot_be_an_animation_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = read_mesh_file(golden("cube.obj", tmp_path / "in"))
    frames, out = moves(read, 3), tmp_path / "out" / "moving.glb"

    def failing() -> Iterator[NDArray[np.float64]]:
        yield from frames
        raise KeyboardInterrupt

    with pytest.raises(MeshError, match="needs at least one frame"):
        write_animation(read, frames[:0], out, frames_per_second=10)
    with pytest.raises(MeshError, match="the posed ones are"):
        write_animation(read, [*frames, frames[0, :3]], out, frames_per_second=10)
    with pytest.raises(MeshError, match=r"is a \.glb file"):
        write_animation(read, frames, out.with_suffix(".obj"), frames_per_second=10)
    with pytest.raises(MeshError, match="above 0, not 0"):
        write_animation(read, frames, out, frames_per_second=0)
    with pytest.raises(KeyboardInterrupt):
        write_animation(read, failing(), out, frames_per_second=10)
    monkeypatch.setattr(mesh_glb_written, "FRAME_LIMIT", 2)
    with pytest.raises(MeshError, match="more than 2 frames"):
        write_animation(read, frames, out, frames_per_second=10)
    monkeypatch.setattr(mesh_glb_written, "GLB_LIMIT", 100)
    with pytest.raises(MeshError, match="4 GiB"):
        write_animation(read, frames[:2], out, frames_per_second=10)
    assert not list((tmp_path / "out").iterdir())
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError, match=r"could not write to .*: "):
        write_animation(read, frames, tmp_path / "file" / "moving.glb", frames_per_second=10)


def test_frames_in_natural_order_from_a_folder_or_a_pattern(tmp_path: Path) -> None:
    names = [f"walk_{number}.obj" for number in (1, 2, 10, 11)]
    for name in [*reversed(names), "rest_1.obj", "notes.txt", ".hidden.obj"]:
        (tmp_path / name).write_text("x")
    assert [path.name for path in frames_of(tmp_path)] == ["rest_1.obj", *names]
    assert [path.name for path in frames_of(tmp_path / "walk_*.obj")] == names


def test_places_without_frames(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="holds no mesh files"):
        frames_of(tmp_path)
    with pytest.raises(MeshError, match="holds no mesh files"):
        frames_of(tmp_path / "*.obj")
    with pytest.raises(MeshError, match="no mesh file or folder at"):
        frames_of(tmp_path / "none")
    for name in ("1.obj", "2.ply"):
        (tmp_path / name).write_text("x")
    with pytest.raises(MeshError, match="several formats"):
        frames_of(tmp_path)


def test_the_header_counts_what_streams_behind_it(tmp_path: Path) -> None:
    read = read_mesh_file(golden("cube.obj", tmp_path))
    write_animation(read, moves(read, 40), tmp_path / "moving.glb", frames_per_second=10)
    content = (tmp_path / "moving.glb").read_bytes()
    length = struct.unpack_from("<I", content, 12)[0]
    described = json.loads(content[20 : 20 + length])
    last = described["bufferViews"][-1]
    assert last["byteStride"] == 12 and last["byteOffset"] + last["byteLength"] == described["buffers"][0]["byteLength"]
    assert last["byteLength"] == 39 * 24 * 24


@pytest.mark.parametrize("name", ["walk_*.off", "walk_%d.off", "walk_%02d.off", "walk_##.off", "walk_[12]*.off"])
def test_patterns_of_frames(tmp_path: Path, name: str) -> None:
    for number in (1, 2, 10):
        (tmp_path / f"walk_{number}.off").write_text("OFF")
    (tmp_path / "body#1.off").write_text("OFF")
    assert is_pattern(tmp_path / name) and not is_pattern(tmp_path / "body#1.off")
    assert [path.name for path in frames_of(tmp_path / name)] == ["walk_1.off", "walk_2.off", "walk_10.off"]
