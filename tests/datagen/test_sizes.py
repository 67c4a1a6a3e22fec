"""What a dataset takes is computed before anything of it is listed, and what memory or disk cannot hold is refused."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen import sizes
from datagen.common.errors import DatasetError, OutOfMemory, RecipeError, StorageError
from datagen.common.resources import bytes_text, memory_errors, ran_out_of_memory
from datagen.generate import append, generate
from datagen.grid import Grid, GridArrays
from datagen.recipe import AnnyBody, DatasetRecipe, MixedBody
from datagen.sizes import duration_text, require_disk, require_memory, size_of
from datagen.store import open_dataset
from tests.support.recipes import tiny_dataset

COUNTS = st.integers(0, 7)
GROWTH = st.fixed_dictionaries({"training": COUNTS, "evaluation": COUNTS, "seen": COUNTS, "unseen": COUNTS})


@given(
    training=st.integers(1, 5), evaluation=COUNTS, seen=st.integers(1, 9), unseen=COUNTS,
    rows=st.integers(1, 5), growth=st.lists(GROWTH, max_size=3),
)  # fmt: skip
def test_counts_without_lists_are_those_of_the_lists(
    training: int, evaluation: int, seen: int, unseen: int, rows: int, growth: list[dict[str, int]]
) -> None:
    grid = Grid(
        tiny_dataset(
            identities={"training": training, "evaluation": evaluation},
            poses={"seen": seen, "unseen": unseen},
            store={"poses_per_shard": rows},
            growth=growth,
        )
    )
    shards = GridArrays(grid, [0] * grid.identity_count, [32]).shards()
    assert grid.shard_count == len(shards)
    assert grid.mesh_count == sum(shard.rows for shard in shards)
    assert grid.identity_count == len({*grid.identities("training"), *grid.identities("evaluation")})
    assert grid.pose_count == len(grid.poses("seen")) + len(grid.poses("unseen"))


HUGE: dict[str, tuple[dict[str, Any], str]] = {
    "identities": ({"identities": {"training": 10**12}}, "Lower data.identities"),
    "poses": ({"poses": {"seen": 3 * 10**10}}, "Lower data.poses"),
    "triples": ({"triples": {"count": 10**12}}, "Lower data.triples.count"),
    "rings": ({"body": {"family": "leg", "rings": 10**11}}, "Lower the body's vertices"),
    "a part of a mixed body": (
        {"body": {"family": "mixed", "bodies": [{"family": "leg"}, {"family": "leg", "segments": 10**12}]}},
        "Lower the body's vertices",
    ),
    "everything": ({"identities": {"training": 2**63 - 1}, "poses": {"seen": 2**63 - 1}}, "Lower data.identities"),
    "what was appended": ({"growth": [{"seen": 10**11}]}, "Lower data.poses"),
}


@pytest.mark.parametrize("what", HUGE)
def test_what_no_memory_holds_is_refused_at_once_by_everything_that_makes(what: str, tmp_path: Path) -> None:
    changes, says = HUGE[what]
    recipe, began = tiny_dataset(**changes), time.monotonic()
    for make in (require_memory, size_of, lambda recipe: generate(recipe, str(tmp_path / "x.zarr"))):
        with pytest.raises(RecipeError, match=says) as raised:
            make(recipe)
        assert "\n" not in str(raised.value)
    assert time.monotonic() - began < 2 and not list(tmp_path.iterdir())


def test_a_refused_fresh_start_leaves_what_was_there(spoilable: Path) -> None:
    with pytest.raises(RecipeError, match="of memory"):
        generate(tiny_dataset(identities={"training": 10**12}), str(spoilable), fresh=True)
    assert generate(tiny_dataset(), str(spoilable)).attributes["status"] == "complete"


def test_appending_beyond_memory_is_refused_and_the_dataset_stays_whole(spoilable: Path) -> None:
    before = (spoilable / "zarr.json").read_bytes()
    with pytest.raises(RecipeError, match=r"Lower data.identities"):
        append(str(spoilable), training=10**12)
    with pytest.raises(RecipeError, match=r"seen has .* bits, the largest whole number has 63"):
        append(str(spoilable), seen=10**400)
    assert (spoilable / "zarr.json").read_bytes() == before


def test_what_the_format_cannot_hold_is_refused_before_poses_are_drawn(tmp_path: Path, spoilable: Path) -> None:
    many = 2_000_000  # a gigabyte of memory, and minutes of drawing
    with pytest.raises(DatasetError, match=r"A dataset holds up to .* 1,000,000 poses"):
        generate(tiny_dataset(poses={"seen": many}), str(tmp_path / "x.zarr"))
    with pytest.raises(DatasetError, match=r"A dataset holds up to .* 1,000,000 poses"):
        append(str(spoilable), seen=many)
    assert open_dataset(str(spoilable)).grid.pose_count == 10


def test_the_line_that_a_person_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = DatasetRecipe(body=AnnyBody(topology="anny"))
    assert str(size_of(recipe, workers=2)) == (
        "12,800 meshes of 13,718 vertices, 2.1 GB (on disk about 1.8 GB), about 4 s of work"
    )
    monkeypatch.setattr(sizes, "load_body", lambda body: pytest.fail("it is known without loading"))
    assert size_of(tiny_dataset()).vertices == 32
    assert [duration_text(seconds) for seconds in (0.1, 90, 150, 9e3, 1e6, 1e9)] == [
        "1 s", "90 s", "2 minutes", "2 hours", "12 days", "32 years",
    ]  # fmt: skip
    assert [bytes_text(size) for size in (15, 2e6, 3e12, 4e18)] == ["0.0 kB", "2.0 MB", "3.0 TB", "4.0 EB"]


def test_the_estimate_of_the_disk_is_of_the_right_size(tmp_path: Path) -> None:
    recipe = tiny_dataset(body={"family": "leg", "rings": 60, "segments": 50}, poses={"seen": 30, "unseen": 4})
    generate(recipe, str(tmp_path / "x.zarr"))
    taken = sum(path.stat().st_size for path in (tmp_path / "x.zarr").rglob("*") if path.is_file())
    assert 0.7 * taken < size_of(recipe).disk < 1.6 * taken


def test_vertices_that_only_files_tell_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MixedBody, "expected_vertices", None)
    bodies = [{"family": "leg", "rings": 10, "segments": 10}, {"family": "leg", "rings": 20, "segments": 10}]
    mixed = tiny_dataset(body={"family": "mixed", "bodies": bodies}, identities={"training": 2, "evaluation": 2})
    assert size_of(mixed).vertices == 150


def test_a_body_whose_files_are_elsewhere_has_no_known_size() -> None:
    size = size_of(DatasetRecipe.model_validate({"body": {"family": "smpl", "path": "/nowhere.npz"}}))
    assert size.vertices is None and "is known once the body is loaded" in str(size)


def test_the_disk_counts_what_is_there_already(spoilable: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size, there = size_of(tiny_dataset()), sum(p.stat().st_size for p in spoilable.rglob("*") if p.is_file())
    monkeypatch.setattr(sizes, "free_disk", lambda folder: int(size.disk - there) + 1)
    require_disk(size, str(spoilable))
    with pytest.raises(StorageError, match=r"its disk has .* left. Make room, .* or continue all the same with --yes"):
        require_disk(size, str(spoilable.parent / "none.zarr"))


class OutOfMemoryError(RuntimeError):
    """As torch names that of a GPU."""


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        np._core._exceptions._ArrayMemoryError((1 << 50,), np.dtype("u1")),
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 4 bytes."),
        OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB."),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling cublasCreate(handle)"),
    ],
    ids=str,
)
def test_memory_that_ran_out_is_known_by_whatever_says_so(error: Exception) -> None:
    assert ran_out_of_memory(error)
    with pytest.raises(OutOfMemory, match=r"^memory ran out \(.+\). Lower it$"), memory_errors("Lower it"):
        raise error


@pytest.mark.parametrize("error", [RuntimeError("shape mismatch"), ValueError("out of memory"), OSError(12, "")])
def test_other_errors_stay_what_they_are(error: Exception) -> None:
    assert not ran_out_of_memory(error)
    with pytest.raises(type(error)), memory_errors("Lower it"):
        raise error
