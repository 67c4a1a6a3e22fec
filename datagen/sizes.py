"""What a dataset takes: meshes, bytes, memory and time, by arithmetic on its recipe, before anything is listed.

Bytes of meshes are exact where the vertex count is. The rest is estimated from measurements: disk and time from
docs/results/benchmarks.md, memory from peaks of whole generations (legs of 32 to 1,000,000 vertices).
"""

from dataclasses import dataclass
from math import prod
from pathlib import Path

from datagen.bodies import load_body
from datagen.common.errors import DsffnetError, RecipeError, StorageError
from datagen.common.files import files_below
from datagen.common.resources import bytes_text, free_disk, free_memory
from datagen.common.seeding import Stream, generator
from datagen.grid import SPLITS, Grid
from datagen.recipe import DatasetRecipe

_VERTEX = 12
"""Bytes of a vertex: three float32."""
_LOOKED_AT = 24
"""Identities whose vertices are counted; characters and mixed bodies differ between identities."""
_DISK_SHARE, _DISK_MESH, _DISK_IDENTITY, _DISK_POSE = 0.85, 120, 100, 600
"""After compression; and bytes beside the vertices. Anny's bodies compress to 0.80, legs to 0.76."""
_SECONDS_MESH, _SECONDS_VERTEX, SECONDS_IDENTITY, SECONDS_POSE = 110e-6, 33e-9, 1e-3, 0.4e-3
_MEMORY_IDENTITY, _MEMORY_POSE, _MEMORY_SHARD, _MEMORY_TRIPLE = 1_500, 2_000, 1_000, 120
"""What the driver keeps, with room to spare: of an identity 0.3 kB (legs) to 1 kB (Anny)."""
_MEMORY_VERTEX, _MEMORY_MESHES = 460, 3
"""Bytes of a body a vertex, and how often a task holds the vertices of its shard."""
_PROCESSES, _OTHERS = "the number of workers", "what other programs take"
"""What to lower where the body's own files and packages need the memory."""


@dataclass(frozen=True)
class DatasetSize:
    """What a dataset takes. ``disk``, ``seconds`` and ``memory`` are estimates; ``vertices`` is None where unknown.

    ``memory`` has bytes by what can be lowered where they are too many: mostly a key of the recipe.
    """

    meshes: int
    vertices: float | None
    disk: float
    seconds: float
    memory: dict[str, float]

    @property
    def bytes(self) -> float:
        """Bytes of all vertices, uncompressed."""
        return self.meshes * (self.vertices or 0) * _VERTEX

    def __str__(self) -> str:
        if self.vertices is None:
            return f"{self.meshes:,} meshes; of how many vertices is known once the body is loaded"
        return (
            f"{self.meshes:,} meshes of {self.vertices:,.0f} vertices, {bytes_text(self.bytes)} "
            f"(on disk about {bytes_text(self.disk)}), about {duration_text(self.seconds)} of work"
        )


def duration_text(seconds: float) -> str:
    """Return a duration as a person says it."""
    for unit, length in (("years", 31_557_600), ("days", 86_400), ("hours", 3_600), ("minutes", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:,.0f} {unit}"
    return f"{max(1, seconds):.0f} s"


def size_of(recipe: DatasetRecipe, *, workers: int = 1) -> DatasetSize:
    """Return what a recipe's dataset takes where ``workers`` tasks run at a time; see :func:`require_memory`.

    A body whose vertex count only its files tell is loaded for it.
    """
    require_memory(recipe, workers=workers)  # first, as loading a body costs the more the larger it is
    if recipe.body.expected_vertices is not None:
        return _sized(recipe, recipe.body.expected_vertices, workers)
    size = _sized(recipe, _loaded_vertices(recipe), workers)
    _require_free(size)
    return size


def require_memory(recipe: DatasetRecipe, *, workers: int = 1) -> None:
    """Refuse a recipe whose dataset this machine's memory has no room to make, as far as its counts tell.

    Raises
    ------
    RecipeError
        It has not; the message names what to lower.
    """
    _require_free(_sized(recipe, recipe.body.expected_vertices, workers))


def require_disk(size: DatasetSize, url: str) -> None:
    """Refuse a dataset that the disk of its folder has no room for; what is there already counts as room.

    Raises
    ------
    StorageError
        It has not.
    """
    folder = Path(url)
    free = free_disk(folder)
    if size.disk > free and size.disk - sum(file.stat().st_size for file in files_below(folder)) > free:
        raise StorageError(
            f"{url} will take about {bytes_text(size.disk)}, but its disk has {bytes_text(free)} left. Make room, "
            "choose another --out, lower data.identities or data.poses, or continue all the same with --yes"
        )


def seconds_of(recipe: DatasetRecipe, meshes: int, vertices: float) -> float:
    """Return the seconds that one core takes to make meshes of so many vertices."""
    return meshes * (_SECONDS_MESH + vertices * _SECONDS_VERTEX + recipe.body.seconds_a_mesh)


def _sized(recipe: DatasetRecipe, vertices: float | None, workers: int) -> DatasetSize:
    grid = Grid(recipe)
    meshes, identities, poses = grid.mesh_count, grid.identity_count, grid.pose_count
    raw = meshes * (vertices or 0) * _VERTEX
    spent = seconds_of(recipe, meshes, vertices or 0)
    return DatasetSize(
        meshes=meshes,
        vertices=vertices,
        disk=_DISK_SHARE * raw + _DISK_MESH * meshes + _DISK_IDENTITY * identities + _DISK_POSE * poses,
        seconds=spent / workers + SECONDS_IDENTITY * identities + SECONDS_POSE * poses,
        memory=_memory_of(grid, vertices or 0, workers),
    )


def _memory_of(grid: Grid, vertices: float, workers: int) -> dict[str, float]:
    """Bytes of memory by the key of the recipe that they are owed to."""
    rows = max(prod(grid.shard_shape(split, identities=grid.identity_count, vertices=vertices)) for split in SPLITS)
    return {
        "data.identities": _MEMORY_IDENTITY * grid.identity_count,
        "data.poses": _MEMORY_POSE * grid.pose_count,
        "data.triples.count": _MEMORY_TRIPLE * grid.recipe.triples.count * 2 * len(grid.steps),
        "data.identities or data.poses": _MEMORY_SHARD * grid.shard_count,
        _PROCESSES if workers > 1 else _OTHERS: workers * grid.recipe.body.worker_bytes,
        "the body's vertices": workers * _MEMORY_VERTEX * vertices,
        "data.store.poses_per_shard": workers * _MEMORY_MESHES * _VERTEX * rows * vertices,
    }


def _loaded_vertices(recipe: DatasetRecipe) -> float | None:
    """Vertices of the first identities on average; None where the body cannot be loaded on this machine."""
    identities = range(min(_LOOKED_AT, Grid(recipe).identity_count))
    try:
        body = load_body(recipe.body)
        drawn = [body.draw_identity(generator(recipe.identities.seed, Stream.IDENTITY, i), i) for i in identities]
        return sum(int(body.faces(parameters).max()) + 1 for parameters in drawn) / len(identities)
    except DsffnetError:  # another machine may have its files; the task that prepares the dataset says what is wrong
        return None


def _require_free(size: DatasetSize) -> None:
    needed, free = sum(size.memory.values()), free_memory()
    if needed > free:
        largest = max(size.memory, key=lambda key: size.memory[key])
        reason = next((key for key, bytes_needed in size.memory.items() if bytes_needed > free), largest)
        raise RecipeError(
            f"making {size.meshes:,} meshes takes about {bytes_text(needed)} of memory, but {bytes_text(free)} are "
            f"free. Lower {reason}"
        )
