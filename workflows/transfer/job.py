"""What ``dsffnet transfer`` is asked for, in paths and numbers, and whether its places can be written."""

import argparse
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from datagen.characters.motion import Motion
from datagen.common.errors import MeshError, RecipeError
from datagen.mesh.files import MeshFile, check_writable, read_mesh_file
from datagen.mesh.formats import FORMATS
from datagen.mesh.sequences import frames_of, is_pattern
from training.inference.orientation import UPRIGHT, Axes, axes_of_both
from workflows.pipeline.weights_argument import projecting

_ANIMATED = ".glb"
_FEWEST_SMOOTHED = 4
_OF_OTHERS = (".gltf", ".fbx", ".abc", ".usd", ".usdz", ".bvh", ".mp4", ".mov", ".gif", ".zip")
"""Of files that others write frames into, which are not written here."""


@dataclass(frozen=True)
class TransferJob:
    """One transfer, or one for each frame of a sequence.

    ``axes``: how source and target stand, None to find it; ``is_told``: a person has said so; ``window``: frames of
    the smoothing; what follows is as on the command line. A sequence is files, or an ``animation`` of one.
    """

    sources: list[Path]
    target: Path
    out: Path
    is_sequence: bool
    axes: tuple[Axes, Axes] | None = (UPRIGHT, UPRIGHT)
    is_told: bool = False
    window: int = 0
    fps: float = 30.0
    refine: bool = False
    project: Path | None = None
    picture: bool = False
    viewer: bool = False
    source_geometry: Sequence[str] = ()
    target_geometry: Sequence[str] = ()
    animation: str | None = None

    @classmethod
    def from_options(cls, options: argparse.Namespace) -> "TransferJob":
        """The job of a command line.

        Raises
        ------
        RecipeError
            The options do not fit together.
        MeshError
            The source names no frames.
        """
        source, target = _two_meshes(options)
        if options.align and (options.up or options.front):
            raise RecipeError("--align finds how the meshes stand; leave it out to say it by --up and --front")
        is_of_files = source.is_dir() or is_pattern(source)
        if options.animation is not None and is_of_files:
            raise RecipeError(f"--animation is of one GLB file, but {source} is frames: leave it out")
        is_sequence = is_of_files or options.animation is not None
        window = _frames_of_window(options.smooth, options.fps)
        if window and not is_sequence:
            raise RecipeError(
                f"--smooth is for frames, but {source} is one mesh; name a folder, a pattern (w*.obj) or an --animation"
            )
        if options.project and not options.model:
            raise RecipeError("--project is for outputs of a network that is named: add --model, or leave it out")
        of_source, of_target = axes_of_both(options.up, options.front)
        return cls(
            sources=frames_of(source) if is_of_files else [source],
            target=target,
            out=Path(options.out),
            is_sequence=is_sequence,
            axes=None if options.align else (of_source, of_target),
            is_told=bool(options.up or options.front),
            window=window,
            project=projecting(options.project),
            **{name: getattr(options, name) for name in _SAME},
        )

    @property
    def is_file(self) -> bool:
        """Whether one file is written, not a folder of frames."""
        return not self.is_sequence or self.out.suffix.lower() == _ANIMATED

    @property
    def animated(self) -> Path:
        """The animated GLB of a sequence."""
        return self.out if self.is_file else self.out / f"animation{_ANIMATED}"

    def beside(self, suffix: str) -> Path:
        """A file beside the output, named after it."""
        return self.out.with_name(f"{self.out.stem if self.is_file else self.out.name}{suffix}")

    @property
    def outputs(self) -> list[Path]:
        """The file that is written, or the animation and the files of the frames."""
        return [self.out] if self.is_file else [self.animated, *map(self.frame_file, range(self.count))]

    @property
    def drawn(self) -> list[Path]:
        """The picture and the page that are asked for."""
        wanted = {".png": self.picture, ".html": self.viewer}
        return [self.beside(suffix) for suffix, is_wanted in wanted.items() if is_wanted]

    @property
    def count(self) -> int:
        """Of sources: frames of a sequence, or one."""
        return self._motion.count if self.animation is not None else len(self.sources)

    def source(self, number: int) -> Path:
        """What the source, or a frame of the sequence, is called; those of an animation are in one file."""
        path = self.sources[0 if self.animation is not None else number]
        return path.with_stem(f"{path.stem}-{number:04d}") if self.animation is not None else path

    def frame_file(self, number: int) -> Path:
        """The file of one frame: named after the source's, of the target's format."""
        return self.out / f"{self.source(number).stem}{self.target.suffix.lower()}"

    def read_source(self, number: int) -> MeshFile:
        """The source, or a frame of the sequence."""
        if self.animation is not None:
            return replace(self._motion.file, mesh=self._motion.mesh(number))
        return read_mesh_file(self.sources[number], geometries=self.source_geometry, is_body=True, points=True)

    @cached_property
    def _motion(self) -> Motion:
        assert self.animation is not None
        file = read_mesh_file(self.sources[0], geometries=self.source_geometry)
        return Motion.of(file, self.animation, frames_per_second=self.fps)

    def read_target(self) -> MeshFile:
        """The target with all that is needed to write it again."""
        return read_mesh_file(self.target, geometries=self.target_geometry, is_body=True)

    def check_places(self) -> None:
        """Refuse, before any work, what could not be written at its end, or would write over what is read.

        Raises
        ------
        MeshError
            An output is an input, or of an unknown format.
        StorageError
            A place cannot be written.
        """
        read = {os.path.realpath(path) for path in (*self.sources, self.target)}
        outputs = self.outputs
        folder = next((path for path in self.drawn if path.is_dir()), None)
        if folder is not None:
            raise MeshError(f"{folder} is a folder, where --picture or --viewer would write; choose another --out")
        taken = next((path for path in outputs if os.path.realpath(path) in read), None)
        if taken is not None:
            raise MeshError(f"{taken} is one of the meshes to read, which are never written over; choose another --out")
        if len(set(outputs)) < len(outputs):
            raise MeshError(f"two frames of {self.sources[0].parent} have one name; rename them, or write a .glb")
        if self.is_file:
            check_writable(self.out)
        elif self.out.exists() and not self.out.is_dir():
            raise MeshError(f"{self.out} is a file; frames go into a folder, or into one .glb")
        elif not self.out.exists() and self.out.suffix.lower() in (*FORMATS, *_OF_OTHERS):
            raise MeshError(
                f"{self.out}: frames go into a folder or into one .glb, not into one {self.out.suffix}; choose "
                f"--out {self.out.with_suffix(_ANIMATED)} or --out {self.out.with_suffix('')}"
            )
        else:
            # not yet the folder itself: it appears when the last frame is done
            check_writable((self.out if self.out.is_dir() else self.out.parent) / self.animated.name)

    def check_textures(self, source: MeshFile, target: MeshFile) -> None:
        """Refuse a picture in the place of a texture of the meshes, or of one that is copied beside the output.

        Raises
        ------
        MeshError
            It would be written over.
        """
        if not self.picture:
            return
        kept = {(mesh.path.parent / name).resolve() for mesh in (source, target) for name in _beside(mesh)}
        if self.is_file and self.out.suffix.lower() == self.target.suffix.lower():
            kept |= {(self.out.parent / name).resolve() for name in _beside(target)}
        if self.beside(".png").resolve() in kept:
            raise MeshError(f"--picture would write over the texture {self.beside('.png')}; choose another --out")


def _beside(mesh: MeshFile) -> Iterable[str]:
    """Material libraries and textures that a mesh file names."""
    return mesh.content.companions().beside


_SAME = ("fps", "refine", "picture", "viewer", "source_geometry", "target_geometry", "animation")


def _two_meshes(options: argparse.Namespace) -> tuple[Path, Path]:
    named = [path for path in (options.source, options.target) if path]
    given = [*options.paths, *named]
    if len(given) != 2 or len(named) == 1:
        raise RecipeError("name two meshes: --source A --target B, or both in this order: SOURCE TARGET")
    return Path(given[0]), Path(given[1])


def _frames_of_window(word: str, fps: float) -> int:
    """``7`` frames, or ``0.2s`` at so many frames a second."""
    found = re.fullmatch(r"(\d+)|(\d*\.?\d+)\s*s", word.strip())
    if found is None:
        raise RecipeError(f"--smooth {word!r} is neither a number of frames such as 7 nor a time such as 0.2s")
    frames = int(found[1]) if found[1] else round(float(found[2]) * fps)
    if frames < _FEWEST_SMOOTHED and float(found[1] or found[2]) > 0:
        least = _FEWEST_SMOOTHED if found[1] else f"{_FEWEST_SMOOTHED / fps:.2g}s"
        raise RecipeError(
            f"--smooth {word!r} takes {frames} frames: fewer than {_FEWEST_SMOOTHED} smooth nothing. At {fps:g} frames "
            f"a second take {least} or more, or 0"
        )
    return frames
