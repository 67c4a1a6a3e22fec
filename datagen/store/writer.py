"""Writing a dataset: begin (metadata, idempotent), one whole shard at a time, finish (manifest and status last).

Every step can be repeated after any interruption and leaves the same bytes: small arrays are written only where they
are not there yet, a shard is written once and whole by one task, and ``status: complete`` is the very last write.
"""

import contextlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from datagen.common.errors import (
    DatasetError,
    NoDataset,
    ShardDamage,
    ShardMismatch,
    StorageError,
    UnsafeFileError,
    storage_errors,
)
from datagen.grid import HOLE, Grid, GridArray, GridArrays, PoseType, Shard
from datagen.mesh.geometry import Bounds
from datagen.mesh.geometry import bounds as bounds_of
from datagen.mesh.rig import Rigs
from datagen.recipe import DatasetRecipe
from datagen.store.arrays import ArrayDamage, put_array, put_group, put_json, read_json, vertices_metadata
from datagen.store.attributes import check_same_assets, check_same_recipe, with_history
from datagen.store.manifest import (
    SEAL,
    SO_FAR,
    ManifestRow,
    ShardTable,
    SoFar,
    changed_objects,
    commit,
    is_sealed,
    paths_of,
    put_so_far,
    read_manifest,
    read_so_far,
    row_of,
)
from datagen.store.object_names import MEMBERS
from datagen.store.objects import delete_object, list_leftovers, read_bytes, stored_sizes, write_bytes
from datagen.store.schema import (
    FORMAT_VERSION,
    attributes_of,
    check_extent,
    check_shards,
    codec_of,
    create_group,
    open_group,
    stored_arrays,
)

SmallArray = tuple[str, NDArray[Any], tuple[str, ...]]
"""Path, values and dimension names."""


@dataclass(frozen=True)
class Plan:
    """Everything of a dataset but the vertices of its shards.

    Attributes
    ----------
    attributes
        What the root says of the dataset, see docs/dataset-format.md.
    provenance
        What makes it, here and now.
    arrays
        Where its meshes go.
    parameters
        Of the body model, float64 [identity, parameter].
    faces
        Triangles int32 [face, 3] of each topology.
    labels
        The part int32 [vertex] that each vertex of a topology belongs to, by number, where bodies say so.
    poses
        Axis-angle rotations in radians, float64 [pose, joint, 3].
    triples
        Evaluation triples int32 [triple, 4] of each pose type.
    rigs
        The rigs of identities whose bodies have the same parts, in the order of the attribute ``rigs``.
    rig_numbers
        Which of them each identity belongs to, int32 [identity]; -1 where its body has no skeleton.
    """

    attributes: Mapping[str, Any]
    provenance: Mapping[str, Any]
    arrays: GridArrays
    parameters: NDArray[np.float64]
    faces: Sequence[NDArray[np.int32]]
    labels: Mapping[int, NDArray[np.int32]]
    poses: NDArray[np.float64]
    triples: Mapping[PoseType, NDArray[np.int32]]
    rigs: Sequence[Rigs]
    rig_numbers: NDArray[np.int32]

    @property
    def recipe(self) -> DatasetRecipe:
        """The recipe that it was made from."""
        return self.arrays.grid.recipe

    def small_arrays(self) -> Iterator[SmallArray]:
        """All arrays but those of vertices."""
        yield "grid/topology", self.arrays.topologies, ("identity",)
        yield "topology/vertex_count", np.array(self.arrays.vertices, np.int32), ("topology",)
        for topology, faces in enumerate(self.faces):
            yield f"topology/{topology}/faces", faces, ("face", "corner")
        for topology, labels in self.labels.items():
            yield f"topology/{topology}/part", labels, ("vertex",)
        yield "pose/parameters", self.poses, ("pose", "joint", "axis")
        for pose_type, triples in self.triples.items():
            yield f"evaluation/{pose_type}", triples, ("triple", "column")
        for array in self.arrays.arrays:
            yield from self._axes(array)
        if self.rigs:
            yield "rig/number", self.rig_numbers, ("identity",)
        for number, rigs in enumerate(self.rigs):
            yield f"rig/{number}/weights", rigs.weights, ("kind", "vertex", "part")
            yield f"rig/{number}/kind", rigs.kinds, ("identity",)
            yield f"rig/{number}/joints", rigs.joints, ("identity", "part", "axis")
            yield f"rig/{number}/corrections", rigs.corrections, ("part", "row", "column")

    def _axes(self, array: GridArray) -> Iterator[SmallArray]:
        parameters = np.where((array.identities == HOLE)[:, None], np.nan, self.parameters[array.identities])
        yield f"{array.path}/identity", array.identities, ("identity",)
        yield f"{array.path}/pose", array.poses, ("pose",)
        yield f"{array.path}/parameters", parameters, ("identity", "parameter")


def begin(
    url: str,
    plan: Plan,
    *,
    growing: bool = False,
    lost: Sequence[str] = (),
    so_far: SoFar | None = None,
) -> None:
    """Create the dataset, or whatever an interrupted ``begin`` left out of it.

    Parameters
    ----------
    growing
        A complete dataset is there, of the recipe before its last step: from here on it is one in the making.
    lost
        Objects other than shards that were lost or changed, to be made again.
    so_far
        The shards that were written before (:func:`known_shards`), which are committed with the objects. It is kept
        apart first: a manifest that is being written is none.

    Raises
    ------
    DatasetError
        A dataset of another recipe, other assets or another version is there already, or something else is.
    """
    with _writing(url):
        check_extent(url, plan.recipe)
        check_shards(url, plan.recipe, plan.arrays.shard_count)
        wanted = {**plan.attributes, "format_version": FORMAT_VERSION}
        group = _opened(url, {**wanted, "status": "building", "provenance": dict(plan.provenance)}, growing=growing)
        growth = plan.recipe.growth
        before = plan.recipe.model_copy(update={"growth": growth[:-1]}) if growing else plan.recipe
        check_same_recipe(url, group, before)
        if not lost:
            check_same_assets(url, group, plan.attributes["body"]["assets"])
        present, stated = attributes_of(group), dict(wanted)
        if growing or lost:
            stated["provenance"] = with_history(plan.provenance, present.get("provenance"))
        differs = growing or bool(lost) or {key: present.get(key) for key in wanted} != wanted
        so_far = so_far or SoFar()
        if differs or _is_building(group):
            put_so_far(group, so_far)
        if differs:  # from here on without a seal, until the manifest is committed
            kept = {key: value for key, value in present.items() if key != SEAL}
            group.attrs.put({**kept, **stated, "status": "building"})
        for path in lost:
            if path != "zarr.json":
                delete_object(group, path)
        _put_arrays(group, plan)
        if _is_building(as_it_is_now := open_group(url, mode="r+")):
            commit(as_it_is_now, so_far.written, {})


def _is_building(group: zarr.Group) -> bool:
    """Whether it is being made, and nobody has completed it meanwhile, as on a store without a lock."""
    return attributes_of(group).get("status") == "building"


def _opened(url: str, attributes: dict[str, Any], *, growing: bool) -> zarr.Group:
    try:
        return open_group(url, mode="r+")
    except NoDataset:
        if growing:
            raise
        return create_group(url, attributes)


def _put_arrays(group: zarr.Group, plan: Plan) -> None:
    groups = {path.rpartition("/")[0] for path, _, _ in plan.small_arrays()}
    splits = {f"grid/{array.split}" for array in plan.arrays.arrays}
    topologies = {f"topology/{number}" for number in range(len(plan.faces))}
    for path in sorted({*MEMBERS, *groups, *splits, *topologies} - {"manifest", *({"rig"} - groups)}):
        put_group(group, path)
    for path, values, dimensions in plan.small_arrays():
        put_array(group, path, values, dimensions)
    for array in plan.arrays.arrays:
        document = vertices_metadata(array, codec_of(plan.recipe, array))
        put_json(group, f"{array.path}/vertices/zarr.json", document)


class ShardWriter:
    """Writes shards of the dataset at ``url``, for as long as it is still the one that a task was sent to make.

    Raises
    ------
    DatasetError
        It has been removed, or begun anew by another recipe; also later, before anything is written.
    """

    def __init__(self, url: str, recipe: DatasetRecipe) -> None:
        self.group, self._url, self._recipe = open_group(url, mode="r+"), url, recipe
        self._sha256 = recipe.sha256()
        self._require_driven()

    def _require_driven(self) -> None:
        """Look at its root as it is now: another process may have begun another dataset."""
        try:
            attributes = read_json(self.group, "zarr.json").get("attributes")
        except ArrayDamage:
            attributes = None
        if not isinstance(attributes, dict):
            raise DatasetError(
                f"{self._url} has been removed meanwhile, or its zarr.json cannot be read; this task writes nothing. "
                "Run the same command again"
            )
        if attributes.get("recipe_sha256") != self._sha256:
            raise DatasetError(
                f"{self._url} is being made by another recipe now; this task leaves it alone. Run one at a time"
            )

    def write(
        self, shard: Shard, meshes: Iterable[tuple[NDArray[np.float32], Bounds]], *, committed: str | None = None
    ) -> ManifestRow:
        """Write one whole shard, and return its manifest row.

        Parameters
        ----------
        shard
            Where it belongs.
        meshes
            Vertices [mesh, vertex, 3] and bounds of its rows, in order, some at a time.
        committed
            The hash that the dataset's manifest has of it, if any.

        Raises
        ------
        DatasetError
            The bytes are not those that were committed, or the meshes are not of its array's shape; nothing is
            written then.
        """
        lows, highs = list[NDArray[np.float32]](), list[NDArray[np.float32]]()

        def looked_at() -> Iterator[NDArray[np.float32]]:
            for vertices, (low, high) in meshes:
                lows.append(low)
                highs.append(high)
                yield vertices

        try:
            content = codec_of(self._recipe, shard).encode(looked_at(), len(shard.identities), len(shard.poses))
        except ShardMismatch as error:
            raise DatasetError(f"{self._url}: shard {shard.path} came out with {error}") from error
        row = row_of(shard, content, (np.concatenate(lows), np.concatenate(highs)))
        if committed not in (None, row.blake3):
            raise DatasetError(
                f"{self._url}: shard {shard.path} was made again, but not the same: other package versions made it "
                f"(dsffnet inspect {self._url} names them). Install those, or make the dataset anew with --fresh"
            )
        self._require_driven()
        with _writing(self._url):
            write_bytes(self.group, shard.path, content)
            if stored_sizes(self.group, [shard.path]) != {shard.path: len(content)}:
                raise DatasetError(
                    f"{self._url}: shard {shard.path} is not there as it was written; is the storage sound?"
                )
        return row


def existing_shard(group: zarr.Group, recipe: DatasetRecipe, shard: Shard) -> ManifestRow | None:
    """The manifest row of a shard that is there, whole and sound; None where it is missing, damaged or unreadable."""
    try:
        content = read_bytes(group, shard.path, limit=codec_of(recipe, shard).most_bytes)
    except (OSError, UnsafeFileError):
        return None
    meshes = None if content is None else decoded(content, recipe, shard)
    return None if content is None or meshes is None else row_of(shard, content, bounds_of(meshes))


def decoded(content: bytes, recipe: DatasetRecipe, shard: Shard) -> NDArray[np.float32] | None:
    """The meshes [mesh, vertex, 3] that a shard's bytes hold; None where they are damaged."""
    codec = codec_of(recipe, shard)
    try:
        return codec.decode(content, codec.rows_of(len(shard.identities), len(shard.poses)))
    except ShardDamage:
        return None


def begun(url: str, recipe: DatasetRecipe, attributes: Mapping[str, Any]) -> GridArrays | None:
    """Where the meshes go of a dataset of which all but shards is there, as it was written; None where it is not.

    Raises
    ------
    DatasetError
        A dataset of another recipe or of another version is there.
    """
    try:
        group = open_group(url)
    except NoDataset:
        return None
    check_same_recipe(url, group, recipe)
    present, manifest = attributes_of(group), read_manifest(group)
    if manifest is None or not manifest.objects or not is_sealed(group) or any(changed_objects(group, manifest)):
        return None
    if any(present.get(key) != value for key, value in attributes.items()):
        return None
    try:
        return stored_arrays(group, Grid(recipe))
    except ArrayDamage:
        return None


def known_shards(url: str, faulty: Collection[str] = ()) -> SoFar:
    """The shards that were written before: sound are those that are there, of the size that was written.

    None is sound where what is said of them is not to be believed: the root's attributes were changed, they or the
    manifest are among the ``faulty`` objects, or what was kept of a dataset in the making is damaged.
    """
    try:
        group = open_group(url)
    except NoDataset:
        return SoFar()
    manifest = read_manifest(group)
    so_far = SoFar(manifest.table) if manifest else SoFar()
    try:
        so_far = (read_so_far(group) if _is_building(group) else None) or so_far
    except ValueError:
        so_far = SoFar(doubted=so_far.sound)
    believed = is_sealed(group) or SEAL not in attributes_of(group)
    if not believed or any(path == "zarr.json" or path.startswith("manifest/") for path in faulty):
        return SoFar(doubted=so_far.written)
    there = _whole(group, so_far.sound, paths_of(so_far.sound), but=faulty)
    return SoFar(so_far.sound[there], np.concatenate([so_far.doubted, so_far.sound[~there]]))


def _whole(
    group: zarr.Group, table: ShardTable, paths: Sequence[str], *, but: Collection[str] = ()
) -> NDArray[np.bool_]:
    """Which shards [shard] of these paths are there, of the size that was written, ``but`` for some."""
    sizes = stored_sizes(group, [path for path in paths if path not in but])
    return np.array([sizes.get(path) == size for path, size in zip(paths, table["bytes"].tolist(), strict=True)], bool)


def save(url: str, recipe: DatasetRecipe, so_far: SoFar) -> None:
    """Keep which shards there are so far, so that a run after an interruption knows them without reading them."""
    with _writing(url):
        group = ShardWriter(url, recipe).group
        if _is_building(group):
            put_so_far(group, so_far)


def finish(url: str, recipe: DatasetRecipe, table: ShardTable, *, written: ShardTable | None = None) -> None:
    """Commit the manifest, the statistics and ``status: complete``; remove what killed writers left of their files.

    Parameters
    ----------
    table
        All shards.
    written
        Of those to look at, their sizes and what lies beside them: where a complete dataset grew, the new ones, as
        the others were looked at when it was opened. By default all.

    Raises
    ------
    DatasetError
        Meanwhile the dataset was begun anew by another recipe, or a shard is not what its task wrote.
    """
    statistics = {
        "meshes": int(table["rows"].sum(dtype=np.int64)),
        "bytes": int(table["bytes"].sum()),
        "minimum": table["extent"][:, 0].min(axis=0).tolist(),
        "maximum": table["extent"][:, 1].max(axis=0).tolist(),
    }
    with _writing(url):
        group = ShardWriter(url, recipe).group
        written = table if written is None else written
        paths = paths_of(written)
        if len(changed := np.flatnonzero(~_whole(group, written, paths))):
            path = paths[changed[0]]
            raise DatasetError(f"{url}: shard {path} was changed by somebody else. Run the same command again")
        for path in list_leftovers(group, paths):
            delete_object(group, path)
        manifest = read_manifest(group) if is_sealed(group) else None
        objects = manifest.objects if manifest else None
        put_so_far(group, SoFar(table))
        commit(group, table, {"statistics": statistics, "status": "complete"}, objects=objects)
        with contextlib.suppress(StorageError):  # it is complete, and where nothing may be removed this is ignored
            delete_object(group, SO_FAR)


def _writing(url: str) -> contextlib.AbstractContextManager[None]:
    advice = "What was complete is untouched; make room or choose another --out, then run the same command again"
    return storage_errors(f"to {url}", advice=advice)
