"""One transfer for the page, by the functions of ``dsffnet transfer``: files in, what the page shows out."""

import argparse
import logging
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from datagen.common.arrays import Floats
from datagen.common.errors import DsffnetError, MeshError, RecipeError
from datagen.common.resources import ran_out_of_memory
from datagen.mesh.files import MeshFile, read_mesh_file, save_mesh
from datagen.mesh.geometry import Mesh, bounding_box
from training.inference.orientation import UPRIGHT, Axes, axes_of_both
from training.inference.standing import Standing
from training.inference.transfer import PoseTransfer
from training.objectives.metrics import recentred_point_mesh_distance
from workflows.demo.bodies import Figure, garments_of, mesh_of, random_figure, truth_of, walk
from workflows.demo.poses import PERSON
from workflows.demo.uploads import FRAME_LIMIT, VERTEX_LIMIT
from workflows.pretrained import name_of
from workflows.transfer.job import TransferJob
from workflows.transfer.run import TransferWork

log = logging.getLogger(__name__)
Body = Figure | tuple[Path, ...]
"""A made-up body, or the files of an upload: one mesh, or frames."""
MOTION_LIMIT = 5_000_000
"""Vertices of all frames of a sequence, of source and target: what is kept of them takes up to 24 bytes each."""
_ONE_AT_A_TIME = threading.Lock()  # so that two people wait for each other rather than both for twice as long


@dataclass(frozen=True)
class Switches:
    """The options of ``dsffnet transfer``, named as there."""

    refine: bool = False
    align: bool = False
    force: bool = False
    project: str | None = None
    up: str | None = None
    front: str | None = None
    smooth: str = "0"
    fps: float = 15.0
    source_geometry: tuple[str, ...] = ()
    target_geometry: tuple[str, ...] = ()
    animation: str | None = None


@dataclass(frozen=True)
class Asked:
    """What a person wants posed; ``moving``: frames, not one pose; ``draped``: the truth also where it is cloth."""

    source: Body
    target: Body
    switches: Switches = field(default_factory=Switches)
    moving: bool = False
    draped: bool = False

    @property
    def needs_draping(self) -> bool:
        """Whether the truth is known by draping alone: a person in clothes, posed like a made-up one."""
        target = self.target
        is_clothed = isinstance(target, Figure) and target.is_clothed
        return is_clothed and isinstance(self.source, Figure) and self.source.kind == PERSON


@dataclass(frozen=True)
class Posed:
    """A frame that is done.

    ``source``, ``target`` and ``output`` stand with Y up, facing +Z; ``posed`` is the output in the target's own axes,
    as it is written. ``truth`` is known of made-up bodies of one kind, and then the PMD (re-centred, in box^2) and
    ``errors`` [v], the distances to it in the target's unit, boxes centred alike.
    """

    source: Mesh
    target: Mesh
    output: Mesh
    posed: Mesh
    truth: Mesh | None = None
    errors: Floats | None = None
    pmd: float | None = None


@dataclass
class Outcome:
    """A transfer as far as it has come: frames, and how many there will be.

    ``garments`` [v]: of a made-up target in clothes, what each vertex belongs to; ``no_truth``: why the truth, which
    was asked for, cannot be had.
    """

    asked: Asked
    file: MeshFile
    frames: list[Posed]
    count: int
    weights: str
    warnings: list[str]
    garments: NDArray[np.integer] | None = None
    seconds: float = 0.0
    no_truth: str = ""

    @property
    def waits_for_draping(self) -> bool:
        """Whether it has no errors yet, which draping would tell."""
        is_open = self.frames[0].errors is None and not self.no_truth
        return is_open and self.asked.needs_draping and not self.asked.moving


class _Remembering(PoseTransfer):
    """Remembers how meshes stand, which takes longer to find than a pose to give, and how well they are read."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__(network)
        self._found = lru_cache(maxsize=32)(self._find)
        self._errors = lru_cache(maxsize=32)(self._error)

    def standing(self, mesh: Mesh) -> Axes | Standing:
        """As found the first time."""
        return self._found(*_bytes(mesh))

    def rest_error(self, mesh: Mesh) -> float:
        """As found the first time."""
        return self._errors(*_bytes(mesh))

    def _error(self, *mesh: bytes) -> float:
        return super().rest_error(_mesh(*mesh))

    def _find(self, *mesh: bytes) -> Axes | Standing:
        return super().standing(_mesh(*mesh))


def _bytes(mesh: Mesh) -> tuple[bytes, bytes]:
    return mesh.vertices.astype(np.float64).tobytes(), mesh.faces.astype(np.int64).tobytes()


def _mesh(vertices: bytes, faces: bytes) -> Mesh:
    return Mesh(np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3))


class Transfers:
    """Transfers by weights that stay loaded, shared by all who look at the page."""

    def __init__(self, weights: Path | None) -> None:
        """``weights``: None for those that come along and know the meshes."""
        self.weights = weights
        self._load = lru_cache(maxsize=4)(_Remembering.from_run)

    @property
    def finds_standing(self) -> bool:
        """Whether the networks say how a mesh stands, so that it need not be asked to (``align``)."""
        return self.weights is None or self._load(self.weights, project=None).finds_standing

    def warm_up(self, say: Callable[[str], None]) -> None:
        """Load what the first transfer needs, and make it; ``say`` is told what comes next."""
        say("reading people (a minute where Anny is read for the first time)")
        person = random_figure(PERSON, np.random.default_rng(0))
        mesh_of(person)
        say("loading the weights, and posing once")
        with tempfile.TemporaryDirectory() as folder:
            self.run(Asked(person, person), Path(folder), lambda: False, lambda _: None)

    def run(self, asked: Asked, folder: Path, stale: Callable[[], bool], show: Callable[[Outcome], None]) -> None:
        """Pose; ``show`` is given the outcome after every frame, ``stale`` ends a sequence that nobody wants any more.

        Raises
        ------
        DsffnetError
            As ``dsffnet transfer``, and a mesh of more than VERTEX_LIMIT vertices.
        """
        switches = asked.switches
        sources = _files_of(asked.source, folder / "source", moving=asked.moving, animation=switches.animation)
        target = _files_of(asked.target, folder / "target")[0]
        job = _job(asked, sources, target, folder, named=self.weights is not None)
        with _ONE_AT_A_TIME:
            for outcome in self._outcomes(asked, job):
                show(outcome)
                if stale():
                    break

    def _outcomes(self, asked: Asked, job: TransferJob) -> Iterator[Outcome]:
        began, warnings = time.perf_counter(), list[str]()
        first, target = within_limit(job.read_source(0)), within_limit(job.read_target())
        work = TransferWork.of(
            job, self.weights, first=first.mesh, target=target, force=asked.switches.force, load=self._load,
            warn=warnings.append,
        )  # fmt: skip
        garments = garments_of(asked.target) if isinstance(asked.target, Figure) else None
        by = name_of(self.weights) if self.weights else work.by
        outcome = Outcome(asked, target, [], job.count, by, warnings, garments)
        figures = _figures(asked)
        require_room(outcome.count, first.mesh, target.mesh)
        stood = _turned(work.axes[1], target.mesh)
        for number, posed in enumerate(work.posed()):
            mesh = within_limit(job.read_source(number)).mesh if number else first.mesh
            if np.array_equal(mesh.faces, first.mesh.faces):
                mesh = Mesh(mesh.vertices, first.mesh.faces)
            frame = Posed(_turned(work.axes[0], mesh), stood, _turned(work.axes[1], posed), posed)
            if figures and isinstance(asked.target, Figure) and not asked.needs_draping:
                frame = _measured(frame, truth_of(figures[number], asked.target))
            outcome.frames.append(_slim(frame) if job.is_sequence else frame)
            outcome.seconds = time.perf_counter() - began
            yield outcome
        if asked.draped and asked.needs_draping and not asked.moving:  # what takes longer comes after the result
            assert isinstance(asked.target, Figure)
            try:
                outcome.frames[0] = _measured(outcome.frames[0], truth_of(figures[0], asked.target))
            except Exception as error:  # the result is there all the same
                outcome.no_truth = f"The truth could not be draped: {reason_of_failure(error)}"
            yield outcome


def reason_of_failure(error: Exception) -> str:
    """What a person is told; what nobody foresaw goes into the log whole."""
    if isinstance(error, DsffnetError):
        return str(error)
    if ran_out_of_memory(error):
        return "memory ran out: decimate the meshes"
    log.warning("a transfer failed", exc_info=error)
    return f"it failed: {error!r}"


def _figures(asked: Asked) -> list[Figure]:
    if not isinstance(asked.source, Figure):
        return []
    return walk(asked.source) if asked.moving else [asked.source]


def _files_of(body: Body, folder: Path, *, moving: bool = False, animation: str | None = None) -> list[Path]:
    """The files of a body; those of a figure are written, in the place of the last one's."""
    if not isinstance(body, Figure):
        if moving and len(body) == 1 and not animation:
            raise MeshError(
                f"{body[0].name} is one mesh: frames to play come as a .zip of mesh files, or as an animated .glb"
            )
        return list(body) if moving else [body[0]]
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    figures = walk(body) if moving else [body]
    places = [folder / f"{body.name}{f'-{number:03d}' if moving else ''}.ply" for number in range(len(figures))]
    for figure, place in zip(figures, places, strict=True):
        save_mesh(mesh_of(figure), place)
    return places


def read(path: Path, geometries: Sequence[str] = ()) -> MeshFile:
    """As ``dsffnet transfer`` reads it; MeshError also where it has more vertices than the page takes."""
    return within_limit(read_mesh_file(path, geometries=geometries, is_body=True))


def within_limit(file: MeshFile) -> MeshFile:
    """The file; MeshError where it has more vertices than the page takes."""
    if len(file.mesh.vertices) > VERTEX_LIMIT:
        raise MeshError(
            f"{file.path} has {len(file.mesh.vertices):,} vertices, the page takes {VERTEX_LIMIT:,}: decimate it, or "
            "use dsffnet transfer"
        )
    return file


def _job(asked: Asked, sources: list[Path], target: Path, folder: Path, *, named: bool) -> TransferJob:
    """The job of the command line that would do the same; ``named``: weights are."""
    options = argparse.Namespace(
        paths=[str(sources[0]), str(target)], source=None, target=None, out=folder / "posed.glb",
        picture=False, viewer=False, model=named, **vars(asked.switches),
    )  # fmt: skip
    made_up = [isinstance(body, Figure) for body in (asked.source, asked.target)]
    if any(made_up) and (all(made_up) or options.up or options.front):  # what is chosen is said of one's own mesh
        options.up = ",".join(UPRIGHT.up if known else options.up or UPRIGHT.up for known in made_up)
        own = axes_of_both(asked.switches.up, asked.switches.front)[0]
        options.front = ",".join(UPRIGHT.front if known else own.front for known in made_up)
        options.align = options.align and not all(made_up)
    if not asked.moving:
        options.smooth = "0"
    if not asked.moving or options.animation:
        return TransferJob.from_options(options)
    options.paths[0] = str(sources[0].parent)
    return replace(TransferJob.from_options(options), sources=sources)


def clash_of(source: Body, target: Body, switches: Switches) -> str | None:
    """What is to be chosen yet where Up and Front, said of a mesh of one's own, are along one line."""
    if isinstance(source, Figure) and isinstance(target, Figure):
        return None
    try:
        axes_of_both(switches.up, switches.front)
    except RecipeError as error:
        return str(error)
    return None


def require_room(frames: int, source: Mesh, target: Mesh) -> None:
    """Refuse a sequence that is too much to be kept and played.

    Raises
    ------
    MeshError
        It has more than FRAME_LIMIT frames, or these more than MOTION_LIMIT vertices in all, of source and of target.
    """
    if frames > FRAME_LIMIT:
        raise MeshError(
            f"{frames:,} frames, the page plays {FRAME_LIMIT:,}: cut the animation, or use dsffnet transfer"
        )
    vertices = len(source.vertices) + len(target.vertices)
    if frames > 1 and frames * vertices > MOTION_LIMIT:
        raise MeshError(
            f"{frames:,} frames of {vertices:,} vertices (source and target) are {frames * vertices:,}, the page plays "
            f"{MOTION_LIMIT:,}: take fewer frames, decimate the meshes, or use dsffnet transfer"
        )


def _turned(way: Axes | Standing, mesh: Mesh) -> Mesh:
    """The mesh with Y up, facing +Z, as it is shown."""
    return Mesh(way.turned(mesh.vertices).astype(np.float32), mesh.faces)


def _slim(frame: Posed) -> Posed:
    """A frame of many, as it is kept: float32, and no truth, which nothing shows."""
    errors = None if frame.errors is None else frame.errors.astype(np.float32)
    posed = Mesh(frame.posed.vertices.astype(np.float32), frame.posed.faces)
    return replace(frame, posed=posed, truth=None, errors=errors)


def _measured(frame: Posed, truth: Mesh | None) -> Posed:
    """With the distances to the truth, both boxes centred alike."""
    if truth is None:
        return frame
    box = bounding_box(truth.vertices)
    right = truth.vertices - box.centre
    ours = frame.posed.vertices - bounding_box(frame.posed.vertices).centre
    boxed = [torch.from_numpy(np.asarray(mesh / box.half, np.float64))[None] for mesh in (ours, right)]
    errors = np.linalg.norm(ours - right, axis=1)
    return replace(frame, truth=truth, errors=errors, pmd=float(recentred_point_mesh_distance(*boxed)[0]))
