"""One shard file: the bytes that Zarr itself writes, and nothing but an error from bytes that were spoiled."""

import json
from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.common.errors import ShardDamage, ShardMismatch
from datagen.grid import GridArray
from datagen.store.arrays import vertices_metadata
from datagen.store.codec import ShardCodec


def meshes(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(*shape, 3)).astype(np.float32)


def array_of(url: Path, codec: ShardCodec, identities: int, poses: int) -> zarr.Array:
    """An array whose metadata are the format's, for Zarr to write or read."""
    numbers = np.arange(identities, dtype=np.int32), np.arange(poses, dtype=np.int32)
    found = GridArray("training", 0, codec.vertices, *numbers, (codec.identities, codec.poses))
    url.mkdir()
    (url / "zarr.json").write_text(json.dumps(vertices_metadata(found, codec)))
    return zarr.open_array(str(url), mode="r+", zarr_format=3)


@pytest.mark.parametrize("compressor, level", [("lz4", 5), ("zstd", 3), ("lz4", 1)])
@pytest.mark.parametrize("poses, room", [(4, 4), (3, 4), (1, 1)])
def test_the_bytes_of_one_identity_are_those_that_zarr_writes(
    tmp_path: Path, compressor: str, level: int, poses: int, room: int
) -> None:
    codec = ShardCodec(1, room, 70, compressor, level)  # type: ignore[arg-type]
    array_of(tmp_path / "v", codec, 1, poses)[...] = meshes(1, poses, 70)
    assert (tmp_path / "v/c/0/0/0/0").read_bytes() == codec.encode(meshes(1, poses, 70), 1, poses)


@pytest.mark.parametrize("identities, poses", [(1, 4), (5, 7), (3, 3), (7, 1)])
def test_zarr_reads_what_is_encoded_here(tmp_path: Path, identities: int, poses: int) -> None:
    """Also shards at the edges, which are filled in part."""
    codec, values = ShardCodec(3, 4, 70, "lz4", 5), meshes(identities, poses, 70)
    array = array_of(tmp_path / "v", codec, identities, poses)
    for row in range(0, identities, 3):
        for column in range(0, poses, 4):
            path = tmp_path / f"v/c/{row // 3}/{column // 4}/0/0"
            path.parent.mkdir(parents=True)
            some = values[row : row + 3, column : column + 4]
            path.write_bytes(codec.encode(some, *some.shape[:2]))
    assert np.array_equal(array[...], values) and np.array_equal(array[-1, -1], values[-1, -1])


def test_what_zarr_writes_is_read_here(tmp_path: Path) -> None:
    codec, values = ShardCodec(3, 4, 70, "lz4", 5), meshes(2, 3, 70)
    array_of(tmp_path / "v", codec, 2, 3)[...] = values
    read = codec.decode((tmp_path / "v/c/0/0/0/0").read_bytes(), codec.rows_of(2, 3))
    assert np.array_equal(read.reshape(values.shape), values)


@given(st.integers(0, 10**9), st.sampled_from(["flip", "cut", "zero"]))
@settings(max_examples=200)
def test_spoiled_bytes_are_never_wrong_meshes(place: int, how: str) -> None:
    codec = ShardCodec(2, 3, 30, "lz4", 5)
    content = bytearray(codec.encode(meshes(2, 2, 30), 2, 2))
    place %= len(content)
    before = bytes(content)
    if how == "flip":
        content[place] ^= 1 << place % 8
    elif how == "cut":
        content = content[:place]
    else:
        content[place : place + 8] = bytes(min(8, len(content) - place))
    if bytes(content) == before:
        return
    with pytest.raises(ShardDamage):
        codec.decode(bytes(content), codec.rows_of(2, 2))


@pytest.mark.parametrize("made", [(1, 3, 30), (1, 5, 30), (1, 1, 30), (1, 4, 31), (1, 8, 15), (1, 2, 60)])
def test_other_meshes_than_there_are_cells_for_are_not_encoded(made: tuple[int, int, int]) -> None:
    with pytest.raises(ShardMismatch, match=r"meshes instead of 1 x 4|of shape .* instead of \(30, 3\)"):
        ShardCodec(1, 5, 30, "lz4", 5).encode(meshes(*made), 1, 4)


@pytest.mark.parametrize("identities, poses", [(1, 6), (2, 5)])
def test_more_than_a_shard_has_room_for_is_not_encoded(identities: int, poses: int) -> None:
    with pytest.raises(ShardMismatch, match="with room for 3 x 4"):
        ShardCodec(3, 4, 30, "lz4", 5).encode(meshes(identities, poses, 30), identities, poses)


def test_a_row_that_is_not_there() -> None:
    codec = ShardCodec(1, 5, 30, "lz4", 5)
    with pytest.raises(ShardDamage, match="row 4 is empty"):
        codec.decode(codec.encode(meshes(1, 4, 30), 1, 4), codec.rows_of(1, 5))
