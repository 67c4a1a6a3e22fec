"""How meshes that exist already lie as files: the layouts of FAUST, MultiGarment and NPT.

An identity and a pose have a name, which is their number (or folder) among the files, and a number in the dataset,
which is their place in :attr:`FoundMeshes.identities` and :attr:`FoundMeshes.poses`.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from datagen.common.errors import BodyError, RecipeError
from datagen.recipe import ImportedBody

Layout = Literal["faust", "multigarment", "npt"]
Cell = tuple[str, str]
"""The names of an identity and of a pose."""

_NPT = re.compile(r"((?:[A-Za-z]+_?)?)(\d+)_(\d+)\.(?:obj|ply)")  # 3_17.obj; 3D-CoreNet: id3_17.obj, toy_3_17.ply
_FAUST = re.compile(r"tr_reg_(\d{3})\.ply")
_FAUST_POSES = 10  # of each subject: registration number = 10 * subject + pose
_FAUST_FOLDERS = ("", "registrations", "training/registrations", "MPI-FAUST/training/registrations")
_GARMENT = "smpl_registered.obj"
_LOOKED_FOR = {
    "faust": "files called tr_reg_NNN.ply, there or in training/registrations",
    "multigarment": f"folders with a file {_GARMENT}",
    "npt": "files called I_P.obj, idI_P.obj or toy_I_P.ply (I an identity's number, P a pose's)",
}


@dataclass(frozen=True)
class FoundMeshes:
    """Mesh files by identity and pose, and the names of both in the dataset's order."""

    layout: Layout
    folder: Path
    identities: tuple[str, ...]
    poses: tuple[str, ...]
    files: Mapping[Cell, Path]

    def poses_of(self, identity: str) -> list[str]:
        """The poses, in order, that there is a file of this identity for."""
        return [pose for pose in self.poses if (identity, pose) in self.files]

    def path(self, identity: int, pose: int) -> Path:
        """The file of an identity and a pose, by their numbers in the dataset.

        Raises
        ------
        RecipeError
            There are not so many identities or poses.
        BodyError
            There is no file for the two.
        """
        self.require(identities=identity + 1, poses=pose + 1)
        cell = self.identities[identity], self.poses[pose]
        if cell not in self.files:
            raise BodyError(
                f"{self.folder} has no file {self._file_name(*cell)} (identity {cell[0]}, pose {cell[1]}). Add it, or "
                "leave out its identity or pose: --set data.body.identities=[...] or --set data.body.poses=[...]"
            )
        return self.files[cell]

    def first_path(self, identity: int) -> Path:
        """The file of an identity's first pose, whose faces are the identity's."""
        self.require(identities=identity + 1)
        name = self.identities[identity]
        return self.files[name, self.poses_of(name)[0]]

    def cells(self) -> Iterator[Cell]:
        """Every identity and pose that there is a file of, identity by identity."""
        return ((identity, pose) for identity in self.identities for pose in self.poses_of(identity))

    def require(self, *, identities: int = 0, poses: int = 0) -> None:
        """Refuse a recipe that asks for more than there is (RecipeError with the counts)."""
        for what, wanted, found, counts in (
            ("identities", identities, self.identities, "data.identities.training or data.identities.evaluation"),
            ("poses", poses, self.poses, "data.poses.seen or data.poses.unseen"),
        ):
            if wanted > len(found):
                raise RecipeError(
                    f"the recipe asks for {wanted} {what} or more, but {self.folder} has {len(found)}. Ask for fewer: "
                    f"--set {counts}"
                )

    def _file_name(self, identity: str, pose: str) -> str:
        like = next(path for (owner, _), path in self.files.items() if owner == identity)
        if self.layout == "faust":
            return _faust_name(identity, pose)
        match = _NPT.fullmatch(like.name)
        return f"{match[1]}{identity}_{pose}{like.suffix}" if match else like.name


def find_meshes(body: ImportedBody) -> FoundMeshes:
    """Find the files of a set; none is opened.

    Raises
    ------
    BodyError
        No folder, nothing in it of that layout, two files for one cell, a gap in FAUST, or a name that is not there.
    """
    folder = Path(body.path)
    if not body.path or not folder.is_dir():
        raise BodyError(f"no folder of meshes at {body.path!r}. Name it: --set data.body.path=FOLDER")
    files = {"faust": _faust, "multigarment": _multigarment, "npt": _npt}[body.layout](folder)
    if not files:
        raise BodyError(f"{folder} has no {_LOOKED_FOR[body.layout]}. Name the folder that has, or another layout")
    identities, poses = (sorted({cell[place] for cell in files}, key=_natural) for place in (0, 1))
    found = FoundMeshes(
        body.layout,
        folder,
        _chosen(body.identities, identities, what="data.body.identities", folder=folder),
        _chosen(body.poses, poses, what="data.body.poses", folder=folder),
        files,
    )
    for identity in found.identities:
        if not found.poses_of(identity):
            raise BodyError(f"{folder} has no file of identity {identity} in any of the poses of data.body.poses")
    return found


def _faust(folder: Path) -> dict[Cell, Path]:
    for place in _FAUST_FOLDERS:
        numbers = {int(match[1]): path for path, match in _matching(folder / place, _FAUST)}
        if numbers:
            break
    files = {(str(n // _FAUST_POSES), str(n % _FAUST_POSES)): path for n, path in sorted(numbers.items())}
    for subject in sorted({subject for subject, _ in files}):
        for pose in map(str, range(_FAUST_POSES)):
            if (subject, pose) not in files:
                raise BodyError(
                    f"{folder} has no file {_faust_name(subject, pose)}, though others of subject {subject}. Add it, "
                    "or take away that subject's files"
                )
    return files


def _faust_name(subject: str, pose: str) -> str:
    return f"tr_reg_{_FAUST_POSES * int(subject) + int(pose):03d}.ply"


def _multigarment(folder: Path) -> dict[Cell, Path]:
    return {(path.parent.name, "0"): path for path in sorted(folder.glob(f"*/{_GARMENT}"))}


def _npt(folder: Path) -> dict[Cell, Path]:
    files: dict[Cell, Path] = {}
    for path, match in _matching(folder, _NPT):
        cell = str(int(match[2])), str(int(match[3]))
        if cell in files:
            raise BodyError(
                f"{folder} has two files for identity {cell[0]}, pose {cell[1]}: {files[cell].name} and {path.name}. "
                "Move one set to a folder of its own"
            )
        files[cell] = path
    return files


def _matching(folder: Path, name: re.Pattern[str]) -> Iterator[tuple[Path, re.Match[str]]]:
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if match := name.fullmatch(path.name):
            yield path, match


def _natural(name: str) -> tuple[int, str]:
    return (int(name), "") if name.isdigit() else (-1, name)


def _chosen(asked: Iterable[int | str], there: list[str], *, what: str, folder: Path) -> tuple[str, ...]:
    known, names = set(there), dict[str, None]()
    for name in (name for each in asked for name in _run(str(each), known, what)):
        if name not in known:
            raise BodyError(f"{what}: {folder} has none called {name}; it has {_few(there)}")
        if name in names:
            raise BodyError(f"{what}: {name} is named twice")
        names[name] = None
    return tuple(names or there)


def _run(text: str, known: set[str], what: str) -> Iterator[str]:
    """A run of numbers such as 16-29, or one name."""
    match = re.fullmatch(r"([0-9]{1,9})-([0-9]{1,9})", text)
    if text in known or not match:
        yield text
        return
    first, last = int(match[1]), int(match[2])
    if first > last:
        raise BodyError(f"{what}: the run {text} is empty, as {first} is more than {last}. Write it {last}-{first}")
    yield from map(str, range(first, last + 1))


def _few(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:4])} ... {names[-1]} ({len(names)} in all)"
