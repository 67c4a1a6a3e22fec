"""Meshes of any kind -> a job of ``dsffnet transfer`` -> a posed mesh that can be written as the target's file."""

import argparse
import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import DsffnetError, DsffnetWarning, MeshError, RecipeError
from datagen.common.printable import printable
from datagen.mesh.files import MeshFile, read_mesh_file, write_posed
from datagen.mesh.formats import format_of
from datagen.mesh.formats.surface import Alone, Encoded, Surface
from datagen.mesh.geometries import CHOOSE, require_one_body
from datagen.mesh.geometry import InFaces, Mesh, check_mesh
from datagen.mesh.limits import VERTEX_LIMIT, require_thickness
from training.inference.orientation import axes_of_both
from workflows.cli.transfer import weights_of
from workflows.transfer.job import TransferJob
from workflows.transfer.run import TransferWork

NO_FACES = np.empty((0, 3), np.int64)


@dataclass(frozen=True)
class PosedMesh:
    """The target's faces [f, 3], its vertices [n, 3] float64 in the source's pose, and what was warned of."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    job: TransferJob = field(repr=False)
    target: MeshFile = field(repr=False)
    doubts: tuple[str, ...] = field(default=(), repr=False)

    def export(self, path: str | os.PathLike[str]) -> None:
        """Write a mesh file; the suffix tells the format, and what the target's file has beside positions stays.

        Raises
        ------
        DsffnetError
            The place is one of the meshes that were read, of an unknown format, or cannot be written.
        """
        job = replace(self.job, out=Path(path))
        with _in_words_of_python():
            job.check_places()
            left_out = write_posed(self.target, self.vertices, job.out).left_out
        for line in left_out:
            warnings.warn(printable(f"{job.out.name} does not keep: {line}"), DsffnetWarning, stacklevel=2)


@dataclass(frozen=True)
class Options:
    """What :func:`dsffnet.transfer` is asked for beside the meshes."""

    model: str | os.PathLike[str] | None = None
    refine: bool = False
    align: bool = False
    up: str | None = None
    front: str | None = None
    force: bool = False

    @property
    def weights(self) -> argparse.Namespace:
        """The options by which the command finds its weights."""
        if not isinstance(self.model, str | os.PathLike | None):
            raise RecipeError(f"model={self.model!r} is no path or name of weights")
        model = None if self.model is None else os.fspath(self.model)
        return argparse.Namespace(model=model, checkpoint="result", force=self.force, tracking_uri=None)


def posed(source: Any, target: Any, options: Options) -> PosedMesh:
    """Return the target in the pose of the source, by the work of ``dsffnet transfer``."""
    with _in_words_of_python():
        found = _posed(source, target, options)
    return found


def _posed(source: Any, target: Any, options: Options) -> PosedMesh:
    read = [_mesh_file(given, role) for given, role in ((source, "source"), (target, "target"))]
    job, doubts = _job(read, options), list[str]()
    with weights_of(options.weights) as weights:
        work = TransferWork.of(
            job,
            weights,
            first=read[0].mesh,
            target=read[1],
            force=options.force,
            warn=lambda line: doubts.append(printable(_of_python(line))),
        )
        found = next(work.posed())
    vertices, faces = np.asarray(found.vertices, np.float64), read[1].mesh.faces.astype(np.int64)
    return PosedMesh(vertices, faces, job, read[1], tuple(doubts))


_OF_PYTHON = {
    f"Choose with {CHOOSE}": "Give the one that is the body by itself",
    "choose it by --source-geometry or --target-geometry, or save it by itself": "give it by itself",
    "look at --picture": "look at it",
    "try --refine": "try refine=True",
    "--model dressed": "model='dressed'",
    "choose another --out": "choose another path",
    "add --tracking-uri URI, or set": "set",
    "check --tracking-uri": "check MLFLOW_TRACKING_URI",
}
"""What messages say that a command line is to do, and what is done here."""


@contextmanager
def _in_words_of_python() -> Iterator[None]:
    """Errors of the command as a caller of the function understands them."""
    try:
        yield
    except DsffnetError as error:
        error.args = (_of_python(str(error)),)
        raise


def _of_python(message: str) -> str:
    """A message in which options are arguments: ``--up=Z`` is ``up='Z'``, ``add --force`` is ``add force=True``."""
    for words, ours in _OF_PYTHON.items():
        message = message.replace(words, ours)
    stated = re.compile(r"--(up|front)=([^\s:]+)( (?=--))?")
    message = stated.sub(lambda m: f"{m[1]}='{m[2]}'{', ' if m[3] else ''}", message)
    return re.sub(r"(?<!\S)--([a-z]+)", r"\1", re.sub(r"\badd --([a-z]+)", r"add \1=True", message))


def _job(read: list[MeshFile], options: Options) -> TransferJob:
    if options.align and (options.up or options.front):
        raise RecipeError("align finds how the meshes stand; leave it out to say it by up and front")
    for name, given in (("up", options.up), ("front", options.front)):
        if not isinstance(given, str | None):
            raise RecipeError(f"{name}={given!r} is no text; name an axis, as in {name}='Z', or two, 'SOURCE,TARGET'")
    return TransferJob(
        sources=[read[0].path],
        target=read[1].path,
        out=Path(),
        is_sequence=False,
        axes=None if options.align else axes_of_both(options.up, options.front),
        is_told=bool(options.up or options.front),
        refine=options.refine,
    )


def _mesh_file(given: Any, role: str) -> MeshFile:
    """A mesh as a file that was read: from its path, or from vertices and triangles in memory."""
    if isinstance(given, str | os.PathLike):
        return read_mesh_file(Path(given), is_body=True, points=role == "source")
    mesh = check_mesh(_mesh(given, role), name=role, points=role == "source")
    if len(mesh.vertices) > VERTEX_LIMIT:
        raise MeshError(f"{role} has {len(mesh.vertices):,} vertices, more than {VERTEX_LIMIT:,}: decimate it")
    require_thickness(
        InFaces.checked(mesh, name=role, points=role == "source").mesh.vertices.astype(np.float64), Path(role)
    )
    return MeshFile(Path(role), role, mesh, _InMemory(mesh))


def _mesh(given: Any, role: str) -> Mesh:
    if hasattr(given, "graph") and hasattr(given, "geometry"):
        return _whole(given, role)
    try:
        vertices, faces = (np.array(NO_FACES if each is None else each) for each in _both(given))
    except (AttributeError, TypeError, ValueError, RuntimeError) as error:  # the last of a tensor with a gradient
        raise MeshError(
            f"{role} is a {type(given).__name__}; give a path, an object with vertices [n, 3] and faces [f, 3], or a "
            f"pair of these ({error})"
        ) from error
    for what, array, kinds in (("vertices", vertices, "fiu"), ("faces", faces, "iu")):
        if array.size and array.dtype.kind not in kinds:
            wanted = "whole numbers" if what == "faces" else "real numbers"
            raise MeshError(f"{role}: its {what} are {array.dtype}, not {wanted}")
    faces = faces.reshape(-1, 3) if not faces.size else faces
    return Mesh(vertices.astype(np.float64, copy=False), faces.astype(np.int64, copy=False))


def _both(given: Any) -> Any:
    """Vertices and triangles of what has both or vertices alone, or of a pair; of an array [n, 3] its points."""
    if isinstance(given, np.ndarray) and given.ndim == 2:
        return given, None
    if not hasattr(given, "vertices"):
        return given
    return given.vertices, given.faces if hasattr(given, "faces") else getattr(given, "triangles", None)


def _whole(scene: Any, role: str) -> Mesh:
    """All that a trimesh.Scene shows and has triangles, where it stands, as one mesh.

    Raises
    ------
    MeshError
        There is none, or they do not make one body.
    """
    placed, corners = dict[str, NDArray[np.float64]](), list[NDArray[np.int64]]()
    for node in scene.graph.nodes_geometry:
        place, name = scene.graph[node]
        vertices, faces = (np.asarray(getattr(scene.geometry[name], what, ())) for what in ("vertices", "faces"))
        if not len(faces):
            continue
        is_mirrored = np.linalg.det(place[:3, :3]) < 0
        corners.append((faces[:, ::-1] if is_mirrored else faces) + sum(map(len, placed.values())))
        placed[str(node)] = vertices @ place[:3, :3].T + place[:3, 3]
    if not placed:
        raise MeshError(f"{role} is a scene that shows no triangles; give one that holds the body")
    require_one_body({name: np.array([its.min(axis=0), its.max(axis=0)]) for name, its in placed.items()}, Path(role))
    return Mesh(np.concatenate(list(placed.values())), np.concatenate(corners))


class _InMemory(Alone):
    """Vertices and triangles that lie in no file, so that every format is made anew."""

    name = None
    only_here: list[str]

    def __init__(self, mesh: Mesh) -> None:
        self.vertices = np.asarray(mesh.vertices, np.float64)
        self.surface = Surface(mesh.faces.ravel().astype(np.int64), np.full(len(mesh.faces), 3))
        self.only_here = []

    def rewritten(self, vertices: NDArray[np.float64]) -> Encoded:
        """The same mesh as an OFF file, the plainest there is."""
        return format_of(".off").build(self.surface, vertices, "mesh", None)
