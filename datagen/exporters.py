"""Datasets as mesh files: in the layout that peers' code trains on, or as folders for people to look through."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import chain, groupby
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import DatasetError, MeshError, RecipeError, StorageError
from datagen.common.files import remove_leftovers, write_atomically
from datagen.grid import POSE_TYPES
from datagen.mesh.files import save_mesh
from datagen.mesh.formats.glb_export import parts_draft
from datagen.mesh.formats.glb_writer import Draft
from datagen.mesh.formats.obj import face_lines, vertex_lines
from datagen.mesh.formats.surface import Material, linear
from datagen.mesh.geometry import Mesh
from datagen.mesh.limits import FRAME_LIMIT
from datagen.mesh.parts import part_colors, part_name
from datagen.store import Dataset

ExportLayout = Literal["npt-obj", "npt-ply", "obj", "ply", "glb", "glb-animated"]
_POSES_A_SECOND = 2.0  # of an animation: most datasets' poses are drawn one by one, and are no motion
Cell = tuple[int, int]
"""An identity and a pose."""
CellProgress = Callable[[Sequence[Cell]], Iterable[Cell]]


@dataclass(frozen=True)
class _Names:
    layout: ExportLayout
    prefix: str

    @property
    def flat(self) -> bool:
        return self.layout.startswith("npt-")

    def of(self, cell: Cell) -> str:
        """Path of a mesh's file within the folder; all poses of an identity are in one file where it is animated."""
        if self.layout == "glb-animated":
            return f"identity-{cell[0]:04d}.glb"
        suffix = self.layout.removeprefix("npt-")
        if self.flat:
            return f"{self.prefix}{cell[0]}_{cell[1]}.{suffix}"
        return f"identity-{cell[0]:04d}/pose-{cell[1]:04d}.{suffix}"


def export_dataset(
    dataset: Dataset,
    folder: str | Path,
    *,
    layout: ExportLayout,
    identities: Iterable[int] | None = None,
    poses: Iterable[int] | None = None,
    prefix: str = "",
    fresh: bool = False,
    progress: CellProgress = iter,
) -> int:
    """Write the meshes of a dataset as files and return how many were written.

    A file appears whole or not at all, and one that is there is left as it is; so an export that was interrupted goes
    on where it stopped. Coordinates are the dataset's: metres, Y up, facing +Z, not normalised.

    Parameters
    ----------
    dataset, folder
        What to write, and where.
    layout
        ``npt-obj`` and ``npt-ply``: one folder of ``{identity}_{pose}.obj``, and the evaluation triples as text lists
        in the published order (target, source, truth). ``obj``, ``ply``, ``glb``: ``identity-0003/pose-0012.glb``.
        ``glb-animated``: ``identity-0003.glb``, whose animation goes through the poses, two a second. Of dressed
        people the files of ``glb`` and ``glb-animated`` have a geometry and a material for the skin and for each
        garment, those of ``obj`` a group.
    identities, poses
        Which ones, by number; without them all. An identity is written in those poses that it was made in.
    prefix
        What file names begin with in the npt layouts, of letters, digits, _ and -: nothing for NPT's code, ``id`` for
        3D-CoreNet's people, ``toy_`` for its animals.
    fresh
        Write every file again.
    progress
        Wraps the sequence of meshes, for a progress bar.

    Raises
    ------
    RecipeError
        A layout, identity or pose that does not exist, or a prefix that is more than a piece of a file's name.
    DatasetError
        The folder is a file, or holds something other than an export of this dataset in this layout.
    MeshError
        An animation of more than 2,000 poses; nothing is written.
    StorageError
        A file could not be written, such as on a full disk; those that are there are whole.
    """
    _require_prefix(prefix)
    if layout not in get_args(ExportLayout):
        raise RecipeError(f"no layout {layout!r} to export to; there are {', '.join(get_args(ExportLayout))}")
    place, names, cells = Path(folder), _Names(layout, prefix), _cells(dataset, identities, poses)
    _require_playable(names, cells)
    try:
        _claim(place, _readme(dataset, names, cells))
        remove_leftovers(place)
        return _export(dataset, place, names, progress(cells), fresh)
    except (StorageError, PermissionError) as error:
        raise StorageError(
            f"{error}. What is there is whole: make room or choose another folder (--out), and run the same command "
            "again to resume"
        ) from error


def _export(dataset: Dataset, place: Path, names: _Names, cells: Iterable[Cell], fresh: bool) -> int:
    topology = lru_cache(maxsize=1)(partial(_Topology, dataset, names))
    written = 0
    for name, of in groupby(cells, key=names.of):
        path = place / name
        if not fresh and path.exists():
            continue
        first = next(of)
        if names.layout == "glb-animated":
            frames = (dataset.vertices(*cell).astype(np.float64) for cell in chain([first], of))
            topology(first[0]).draft().animated(frames, path, frames_per_second=_POSES_A_SECOND)
        else:
            topology(first[0]).save(dataset.vertices(*first), path)
        written += 1
    if names.flat:
        _write_lists(dataset, place, names)
    return written


class _Topology:
    """The faces [face, 3] of an identity and, where its layout tells them apart, the parts of its vertices.

    Their lines in OBJ files are made once for all of its poses.
    """

    def __init__(self, dataset: Dataset, names: _Names, identity: int) -> None:
        self._faces, self._count = dataset.faces(identity), dataset.vertex_count(identity)
        self._part = None if names.flat else dataset.part(identity)
        self._lines = ""

    def save(self, vertices: NDArray[np.float32], path: Path) -> None:
        if path.suffix == ".obj":
            self._lines = self._lines or self._face_lines()
            write_atomically(path, (vertex_lines(vertices) + self._lines).encode())
        elif path.suffix == ".glb" and self._part is not None:
            write_atomically(path, self.draft().static(vertices.astype(np.float64)))
        else:
            save_mesh(Mesh(vertices, self._faces), path)

    def draft(self) -> Draft:
        """A GLB file that lacks its positions, a geometry a part."""
        if self._part is None:
            whole = np.zeros(self._count, np.int64)
            return parts_draft(self._faces.astype(np.int64), whole, [Material("body")])
        worn, place = np.unique(self._part, return_inverse=True)
        colors = linear(np.column_stack([part_colors(worn), np.full(len(worn), 255, np.uint8)])) / 65535
        looks = zip(worn.tolist(), colors.tolist(), strict=True)
        return parts_draft(
            self._faces.astype(np.int64), place, [Material(part_name(part), tuple(color)) for part, color in looks]
        )

    def _face_lines(self) -> str:
        if self._part is None:
            return face_lines(self._faces)
        part = self._part[self._faces[:, 0]]
        pieces = np.split(np.arange(len(part)), np.flatnonzero(np.diff(part)) + 1)
        named = ((part_name(int(part[piece[0]])).replace(" ", "-"), face_lines(self._faces[piece])) for piece in pieces)
        return "".join(f"g {name}\n{lines}" for name, lines in named)


def _cells(dataset: Dataset, identities: Iterable[int] | None, poses: Iterable[int] | None) -> list[Cell]:
    grid = dataset.grid
    wanted = list(range(grid.identity_count) if identities is None else identities)
    kept = None if poses is None else set(poses)
    _require("identity", wanted, grid.identity_count)
    _require("pose", kept or (), grid.pose_count)
    made = ((identity, int(pose)) for identity in wanted for pose in grid.poses_of(identity))
    cells = [cell for cell in made if kept is None or cell[1] in kept]
    if not cells:
        raise RecipeError(
            f"nothing to export: none of these identities was made in these poses. dsffnet inspect {dataset.url} shows "
            "what there is; training identities are in the seen poses only"
        )
    return cells


def _require_playable(names: _Names, cells: list[Cell]) -> None:
    most = max(Counter(map(names.of, cells)).values()) if names.layout == "glb-animated" else 0
    if most > FRAME_LIMIT:
        raise MeshError(
            f"{most:,} poses of an identity are more than {FRAME_LIMIT:,}: an animated GLB of so many plays nowhere. "
            "Choose fewer by --poses"
        )


def _require(what: str, numbers: Iterable[int], count: int) -> None:
    for number in numbers:
        if not 0 <= number < count:
            raise RecipeError(f"there is no {what} {number} to export; the dataset's are 0 to {count - 1}")


def _require_prefix(prefix: str) -> None:
    if not re.fullmatch(r"[A-Za-z0-9_-]*", prefix):
        raise RecipeError(
            f"prefix {prefix!r} cannot begin the names of files: letters, digits, _ and - can. Choose another, such as "
            "--prefix id"
        )


def _readme(dataset: Dataset, names: _Names, cells: Sequence[Cell]) -> str:
    """What is in the folder; of animations with the poses, which their files' names do not say."""
    attributes = dataset.attributes
    shown = "identity 0 in pose 0"
    if names.layout == "glb-animated":
        shown = f"identity 0 in its poses among {', '.join(map(str, sorted({pose for _, pose in cells})))}"
    return (
        f"Meshes of the dataset {dataset.uuid}, such as {names.of((0, 0))}, which is {shown}.\n"
        f"Unit: {attributes['units']}. Frame: {attributes['frame']}. Vertices are in the dataset's order.\n"
    )


def _claim(place: Path, readme: str) -> None:
    """Make sure that whatever is in the folder is of this very export: files that are there are not written again."""
    said = place / "README.txt"
    if place.exists() and not place.is_dir():
        raise DatasetError(f"{place} is a file, and an export is a folder of files. Choose another: --out FOLDER")
    if place.is_dir() and any(not entry.name.startswith(".") for entry in place.iterdir()):
        if not said.is_file() or said.read_bytes() != readme.encode():
            raise DatasetError(
                f"{place} holds other files than an export of this dataset in this layout. Choose another folder"
            )
        return
    write_atomically(said, readme.encode())


def _write_lists(dataset: Dataset, place: Path, names: _Names) -> None:
    """The evaluation triples whose three meshes are there, one a line: target, source, truth."""
    there = {path.name for path in place.iterdir()}
    for pose_type in POSE_TYPES:
        lines = []
        for source, source_pose, target, target_pose in dataset.evaluation_triples(pose_type).tolist():
            triple = [names.of(cell) for cell in ((target, target_pose), (source, source_pose), (target, source_pose))]
            if there.issuperset(triple):
                lines.append(" ".join(triple) + "\n")
        if lines:
            write_atomically(place / f"evaluation-{pose_type}.txt", "".join(lines).encode())
