"""A transfer at work: how the meshes stand, what to warn of, the frames, and what a person looks at."""

import contextlib
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from datagen.common.errors import MeshError, storage_errors
from datagen.mesh.files import MeshFile, write_posed
from datagen.mesh.geometry import InFaces, Mesh
from datagen.mesh.sequences import require_animation, write_animation
from training.inference.domain_check import Tears, about_loose, remarks, seen_by
from training.inference.orientation import UPRIGHT, Axes, orientation
from training.inference.standing import MISREAD, Standing
from training.inference.transfer import REFINE_WEIGHT, PoseTransfer
from workflows.pipeline.console import warn
from workflows.pretrained import name_of
from workflows.transfer.choice import Load, Pair, chosen, standings
from workflows.transfer.job import TransferJob

if TYPE_CHECKING:
    from training.viz.look import Look
    from training.viz.transfer_example import Comparison, NamedMesh

_SHOWN_FRAMES = 4  # of a sequence, in its picture
_POINTS_SHOWN = 10_000  # of a source without faces
_VOTING_FRAMES = 3  # of a sequence, on how it stands


class TransferWork:
    """A job whose meshes are read and whose network is loaded."""

    def __init__(
        self,
        job: TransferJob,
        transfer: PoseTransfer,
        *,
        first: Mesh,
        target: MeshFile,
        by: str = "",
        known: Mesh | None = None,
        warn: Callable[[str], None] = warn,
    ) -> None:
        """``first`` is the source, or the first frame of a sequence; ``by``: weights that were chosen; ``known``: what
        comes of the first, neither smoothed nor refined, where it is known.
        """
        self.job, self.transfer, self.first, self.target = job, transfer, InFaces(first).mesh, target
        self._seen = InFaces(target.mesh)
        self.axes: tuple[Axes | Standing, Axes | Standing] = job.axes or (UPRIGHT, UPRIGHT)
        self.by, self._known, self._warn = by, known, warn
        self._is_unrivalled = False  # by human, dressed not being asked
        self._shown: dict[int, Mesh] = {}
        self._played: dict[int, Mesh] = {}
        self._beside: list[Path] = []

    @classmethod
    def of(
        cls,
        job: TransferJob,
        weights: Path | None,
        *,
        first: Mesh,
        target: MeshFile,
        force: bool,
        load: Load | None = None,
        warn: Callable[[str], None] = warn,
    ) -> "TransferWork":
        """The job by weights, or by those of the project's own that know both meshes; how these stand is settled.

        ``load`` makes a network of weights, ``warn`` takes what is to be known of the meshes, a line each.

        Raises
        ------
        MeshError
            Of weights to choose from: one of the meshes is a person and one an animal, and it is not forced.
        """
        seen = InFaces(first), InFaces(target.mesh)
        for path, each in zip((job.sources[0], job.target), seen, strict=True):
            if len(each.loose):
                warn(about_loose(each.loose, name=str(path)))
        meshes = seen[0].mesh, seen[1].mesh
        if weights is None:
            found = chosen(job, meshes, force=force, load=load)
            by, known = found.weights.name, found.posed
            if known is not None and len(seen[1].loose):
                known = Mesh(seen[1].of_all(known.vertices), target.mesh.faces)
            work = cls(job, found.transfer, first=first, target=target, by=by, known=known, warn=warn)
            work._is_unrivalled = found.is_unrivalled
            work._take(found.standings, found.weights, found.doubts)
            return work
        transfer = (load or PoseTransfer.from_run)(weights, project=job.project)
        work = cls(job, transfer, first=first, target=target, warn=warn)
        if work.transfer.finds_standing:
            work._take(standings(work.transfer, job, meshes), weights)
        else:
            work._settle_axes(weights)
        if job.project:
            upright = Mesh(work.axes[1].turned(meshes[1].vertices), meshes[1].faces)
            if not work.transfer.rest_error(upright) <= MISREAD:
                warn(f"{job.target} is no body that {name_of(job.project)} knows: what it takes for parts may be none")
        return work

    def _settle_axes(self, weights: Path) -> None:
        """Find how the meshes stand where that is asked, and warn where they are unlike the training data."""
        errors = self.transfer.self_errors
        ways = [orientation(errors, meshes) for meshes in (self._votes(), [self._seen.mesh.vertices])]
        self.axes = taken = self.job.axes or (ways[0].axes, ways[1].axes)
        seen = seen_by(weights)
        meshes = (self.job.sources[0], self.first), (self.job.target, self._seen.mesh)
        for (path, mesh), axes, way in zip(meshes, taken, ways, strict=True):
            both = ways[0].axes, ways[1].axes
            if self.job.axes is None and not way.is_certain:
                self._warn(f"--align leaves {path} as it is: how it stands is not certain")
            for line in remarks(
                mesh, name=str(path), axes=axes, way=way, both=both, stated=self.job.is_told, seen=seen
            ):
                self._warn(line)

    def _take(self, found: Pair, weights: Path, doubts: tuple[str, str] = ("", "")) -> None:
        """Turn the meshes as they were found to stand; warn of those that the network does not know."""
        self.axes, seen, stated = found, seen_by(weights), self.job.is_told
        meshes = (self.job.sources[0], self.first), (self.job.target, self._seen.mesh)
        for (path, mesh), axes, doubt in zip(meshes, found, doubts, strict=True):
            for line in remarks(
                mesh, name=str(path), axes=axes, way=None, both=None, stated=stated, seen=seen, doubt=doubt
            ):
                self._warn(line)

    def run(self) -> str:
        """Write everything; what was done, and which files were written beside the output, in a line."""
        done = self._write_sequence() if self.job.is_sequence else self._write_pair()
        if self.job.drawn:
            self._draw()
        by = f", by the weights {self.by}" if self.by else ""
        beside = ", ".join(map(str, [*self._beside, *self.job.drawn]))
        return f"{done}{by}{beside and f'; beside it {beside}'}"

    def _votes(self) -> list[NDArray[np.floating]]:
        count = self.job.count
        others = {count * place // _VOTING_FRAMES for place in range(1, _VOTING_FRAMES)} - {0}
        return [self.first.vertices, *(self._source(number).vertices for number in sorted(others))]

    def _source(self, number: int) -> Mesh:
        return self.first if number == 0 else InFaces(self.job.read_source(number).mesh).mesh

    def _write_pair(self) -> str:
        job, posed = self.job, next(self._kept())
        *self._beside, _ = self._write_posed(posed, job.out)
        return f"{job.out}: {len(posed.vertices):,} vertices of {job.target} in the pose of {job.sources[0]}"

    def _write_sequence(self) -> str:
        job = self.job
        about = f"{job.out}: {job.count} frames of {job.target}"
        if job.is_file:
            require_animation(self.target, job.count)
            self._animate(self._kept(), job.animated)
            return about
        with _appearing_whole(job.out, own={path.name for path in job.outputs}) as folder:
            try:
                require_animation(self.target, job.count)
            except MeshError as error:
                warn(f"no {job.animated.name}: {error}")
                deque(self._saved(folder), maxlen=0)
                return about
            self._animate(self._saved(folder), folder / job.animated.name)
        return f"{about}, and all of them in {job.animated.name}"

    def _animate(self, frames: Iterable[Mesh], out: Path) -> None:
        vertices = (frame.vertices for frame in frames)
        left_out = write_animation(self.target, vertices, out, frames_per_second=self.job.fps)
        if left_out and self.job.is_file:  # of frames in files, these say it, or have it
            warn(f"{out.name} does not keep: {'; '.join(left_out)}")

    def _saved(self, folder: Path) -> Iterator[Mesh]:
        """The frames, each written to its file as it passes."""
        for number, posed in enumerate(self._kept()):
            place = folder / self.job.frame_file(number).name
            self._write_posed(posed, place, beside=not number)  # what lies beside the first lies beside all
            yield posed

    def _write_posed(self, posed: Mesh, out: Path, *, beside: bool = True) -> list[Path]:
        written = write_posed(self.target, posed.vertices, out, beside=beside)
        if written.left_out and beside:
            warn(f"{out.name} does not keep: {'; '.join(written.left_out)}")
        return written.files

    def posed(self) -> Iterator[Mesh]:
        """The target in the pose of every source, one after the other; a line says which is torn first."""
        tears, is_torn = Tears(self.target.mesh), False
        for number, posed in enumerate(self._frames(), 1):
            if not is_torn and (line := tears.in_output(posed, name=str(self.job.target))):
                is_torn = True
                others = [] if self.job.refine else ["--refine"]
                if self._is_unrivalled:
                    others.append("--model dressed")
                line += f", and try {' or '.join(others)}" if others else ""
                self._warn(f"frame {number}: {line}" if self.job.is_sequence else line)
            yield posed

    def _frames(self) -> Iterator[Mesh]:
        if self._known and not (self.job.is_sequence or self.job.refine):
            return iter([self._known])
        return self.transfer.sequence(
            map(self._source, range(self.job.count)),
            self.target.mesh,
            smooth=self.job.window,
            refine=REFINE_WEIGHT if self.job.refine else 0.0,
            source_axes=self.axes[0],
            target_axes=self.axes[1],
        )

    def _kept(self) -> Iterator[Mesh]:
        """The outputs, with a bar for those of a sequence; those that picture and page show are kept."""
        count = self.job.count
        kept = {count * place // _SHOWN_FRAMES for place in range(_SHOWN_FRAMES)}
        is_played = self.job.viewer and self.job.is_sequence
        played = range(0, count, self._frames_apart) if is_played else range(0)
        frames = self.posed()
        if self.job.is_sequence:
            from workflows.pipeline.progress import bar

            frames = bar(frames, total=count, what="transfer", unit="frame")
        for number, posed in enumerate(frames):
            if number in kept:
                self._shown[number] = Mesh(posed.vertices[self._seen.rows], self._seen.mesh.faces)
            if number in played:
                seen = posed.vertices[self._seen.rows]
                self._played[number] = Mesh(seen.astype(np.float32), self._seen.mesh.faces)
            yield posed

    @cached_property
    def _frames_apart(self) -> int:
        """The page of a sequence shows every so manieth frame; where that is not all, a line says so."""
        from training.viz.viewer import MOTION_LIMIT, frames_apart

        count = self.job.count
        of_source = len(self.first.vertices) if len(self.first.faces) else len(self._upright_source(0).vertices)
        apart = frames_apart(count, of_source + len(self.target.mesh.vertices))
        if apart > 1:
            warn(
                f"{self.job.beside('.html')} plays one of {apart} frames: all {count:,} take more than "
                f"{MOTION_LIMIT // 10**6} MB. Transfer a part of the sequence to see each"
            )
        return apart

    def _draw(self) -> None:
        from training.viz.comparison_figure import comparison_figure
        from training.viz.transfer_example import PANEL, shown
        from training.viz.viewer import write_viewer

        job, target = self.job, self._upright_target(self._seen.mesh, self.job.target)
        if job.picture or not job.is_sequence:
            rows = [
                shown(self._upright_source(number), target, self._upright_target(posed, self._place(number)))
                for number, posed in self._shown.items()
            ]
        if job.picture:
            comparison_figure(rows, job.beside(".png"), panel=PANEL)
        if job.viewer:
            transfers = [self._sequence(target)] if job.is_sequence else rows
            write_viewer(transfers, job.beside(".html"), title="Pose transfer")

    def _place(self, number: int) -> Path:
        job = self.job
        return job.frame_file(number) if job.is_sequence and not job.is_file else job.out

    def _sequence(self, target: "NamedMesh") -> "Comparison":
        """All frames that the page plays, as one transfer that moves."""
        from training.viz.transfer_example import Motion, shown

        frames = [
            (self._upright_source(number), self._upright_target(posed, self._place(number)))
            for number, posed in self._played.items()
        ]
        motion = Motion(frames, self.job.fps / self._frames_apart)
        title = f"{target.name} in the poses of {self._sequence_name} ({self.job.count:,} frames)"
        return shown(frames[0][0], target, frames[0][1], motion=motion, title=title)

    @property
    def _sequence_name(self) -> str:
        first = self.job.sources[0]
        return first.parent.resolve().name if self.job.animation is None else f"{first.name}: {self.job.animation}"

    def _upright_source(self, number: int) -> "NamedMesh":
        return _upright(self._source(number), self.axes[0], self.job.source(number), self._source_look)

    def _upright_target(self, mesh: Mesh, path: Path) -> "NamedMesh":
        return _upright(mesh, self.axes[1], path, self._target_look)

    @cached_property
    def _source_look(self) -> "Look | None":
        return _look(self.job.read_source(0))

    @cached_property
    def _target_look(self) -> "Look | None":
        return _look(self.target)


def _look(file: MeshFile) -> "Look | None":
    """How a file's faces look, of what is seen of it."""
    from training.viz.look import look_of

    look, seen = look_of(file.content.surface), InFaces(file.mesh)
    if look is None or look.colors is None or not look.fits(len(file.mesh.vertices), len(file.mesh.faces)):
        return look
    return replace(look, colors=look.colors[seen.rows])


def _upright(mesh: Mesh, axes: Axes | Standing, path: Path, look: "Look | None") -> "NamedMesh":
    from training.viz.mesh_grid import drawable  # pictures alone need these
    from training.viz.transfer_example import NamedMesh

    if not len(mesh.faces):
        some = np.linspace(0, len(mesh.vertices) - 1, min(len(mesh.vertices), _POINTS_SHOWN)).astype(int)
        mesh, look = drawable(Mesh(mesh.vertices[some], mesh.faces)), None
    fits = look is not None and look.fits(len(mesh.vertices), len(mesh.faces))
    return NamedMesh(axes.turned(mesh.vertices), mesh.faces, path.name, look if fits else None)


def _move(path: Path, place: Path, *, is_own: bool) -> None:
    if not is_own and place.exists() and place.read_bytes() != path.read_bytes():
        warn(f"{place.name}: another file of that name is in {place.parent} and was left as it is")
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    os.replace(path, place)


@contextmanager
def _appearing_whole(out: Path, *, own: set[str]) -> Iterator[Path]:
    """A folder beside ``out`` to write into, whose files move there only if the block succeeds; else they stay in it.

    Those of ``own`` take the place of an earlier run's; materials and textures leave other files of their name alone.
    """
    with storage_errors(out):
        folder = _new_folder(out)
        try:
            yield folder
            for path in sorted(path for path in folder.rglob("*") if path.is_file()):
                name = path.relative_to(folder)
                _move(path, out / name, is_own=str(name) in own)
        except KeyboardInterrupt as interrupt:
            raise KeyboardInterrupt(f"{_finished_in(folder, own)}; the same command begins again") from interrupt
        except BaseException:
            warn(_finished_in(folder, own))
            raise
        shutil.rmtree(folder)


def _new_folder(out: Path) -> Path:
    """``out``.unfinished, numbered where an earlier run left one."""
    for number in count(1):
        folder = out.with_name(f"{out.name}.unfinished{'' if number == 1 else f'-{number}'}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir(parents=True)
            return folder
    raise AssertionError("there are numbers without end")


def _finished_in(folder: Path, own: set[str]) -> str:
    """How many frames are finished, and where a person finds them; a folder without any is removed."""
    finished = sum(path.name in own for path in folder.iterdir())
    if finished:
        return f"{finished:,} {'frame is' if finished == 1 else 'frames are'} finished, in {folder}"
    shutil.rmtree(folder, ignore_errors=True)
    return "no frame is finished"
