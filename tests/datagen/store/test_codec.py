"""One shard file: the bytes that Zarr itself writes, and nothing but an error from bytes that were spoiled."""

from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.common.errors import ShardDamage
from datagen.store.codec import ShardCodec
from datagen.store.schema import create_vertices_array


def meshes(rows: int, vertices: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, vertices, 3)).astype(np.float32)


@pytest.mark.parametrize("compressor, level", [("lz4", 5), ("zstd", 3), ("lz4", 1)])
@pytest.mark.parametrize("rows, room", [(4, 4), (3, 4), (1, 1)])
def test_the_bytes_are_those_that_zarr_writes(
    tmp_path: Path, compressor: str, level: int, rows: int, room: int
) -> None:
    codec = ShardCodec(room, 70, compressor, level)  # type: ignore[arg-type]
    group = zarr.open_group(str(tmp_path / "x.zarr"), mode="w", zarr_format=3)
    create_vertices_array(group, "v", rows=rows, codec=codec)
    group["v"][...] = meshes(rows, 70)
    assert (tmp_path / "x.zarr/v/c/0/0/0").read_bytes() == codec.encode(meshes(rows, 70))


def test_zarr_reads_what_is_encoded_here(tmp_path: Path) -> None:
    codec = ShardCodec(4, 70, "lz4", 5)
    group = zarr.open_group(str(tmp_path / "x.zarr"), mode="w", zarr_format=3)
    create_vertices_array(group, "v", rows=7, codec=codec)
    for number, part in enumerate((meshes(4, 70), meshes(3, 70, seed=1))):
        path = tmp_path / f"x.zarr/v/c/{number}/0/0"
        path.parent.mkdir(parents=True)
        path.write_bytes(codec.encode(part))
    assert np.array_equal(group["v"][...], np.concatenate([meshes(4, 70), meshes(3, 70, seed=1)]))


@given(st.integers(0, 10**9), st.sampled_from(["flip", "cut", "zero"]))
@settings(max_examples=200, deadline=None)
def test_spoiled_bytes_are_never_wrong_meshes(place: int, how: str) -> None:
    codec = ShardCodec(5, 30, "lz4", 5)
    content = bytearray(codec.encode(meshes(4, 30)))
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
        codec.decode(bytes(content), 4)


def test_a_row_that_is_not_there() -> None:
    codec = ShardCodec(5, 30, "lz4", 5)
    with pytest.raises(ShardDamage, match="row 4 is empty"):
        codec.decode(codec.encode(meshes(4, 30)), 5)
