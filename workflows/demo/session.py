"""What one person at the page has: a folder, and a transfer that follows what they choose."""

import contextlib
import io
import shutil
import tempfile
import threading
import zipfile
from collections import defaultdict
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Generic, NamedTuple, Protocol, TypeVar

from datagen.common.errors import MeshError, NotOneBodyError
from datagen.mesh.files import write_posed
from datagen.mesh.sequences import write_animation
from workflows.demo.captions import plain
from workflows.demo.poses import PoseFile, read_poses
from workflows.demo.transfers import Asked, Outcome, Transfers, read, reason_of_failure
from workflows.demo.uploads import FRAME_LIMIT, keep, keep_poses

Work = TypeVar("Work")


class View(Protocol):
    """What shows a session."""

    def posing(self) -> None:
        """A transfer has begun."""

    def show(self, outcome: Outcome) -> None:
        """A frame is done."""

    def fail(self, message: str) -> None:
        """A transfer cannot be, and there is no result."""


class Result(NamedTuple):
    """A file to download, and what it could not hold, a line each."""

    name: str
    content: bytes
    left_out: list[str]


class Session:
    """One person's meshes, in a folder of their own that goes with them."""

    def __init__(self, folder: Path, transfers: Transfers, view: View) -> None:
        self.folder, self._transfers, self._view = folder, transfers, view
        self.outcome: Outcome | None = None
        self._uploads, self._kept = count(1), defaultdict[str, list[Path]](list)
        self._here = threading.Lock()  # held where the folder is written in, so that nothing comes after its end
        folder.mkdir(parents=True)
        self._newest = Newest(self._pose)

    def ask(self, asked: Asked) -> None:
        """Pose this next, in the place of what waits."""
        self._newest.ask(asked)

    def keep(self, role: str, name: str, content: bytes) -> tuple[Path, ...]:
        """The files of an upload, ``source`` or ``target``, which are found to be meshes.

        Raises
        ------
        DsffnetError
            It is refused; what was uploaded before stays.
        """
        with self._here:
            self._require_open()
            return self._keep(role, name, content)

    def _keep(self, role: str, name: str, content: bytes) -> tuple[Path, ...]:
        folder = self.folder / f"{role}-{next(self._uploads)}"
        try:
            files = keep(name, content, folder, most=1 if role == "target" else FRAME_LIMIT)
            with contextlib.suppress(NotOneBodyError):  # until a person has chosen among its geometries
                read(files[0])
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        self._kept[role].append(folder)
        for former in self._kept[role][:-2]:  # the last one may be read at this moment
            shutil.rmtree(former, ignore_errors=True)
        return tuple(files)

    def keep_poses(self, name: str, content: bytes) -> PoseFile:
        """The poses of an upload, of which no file stays.

        Raises
        ------
        DsffnetError
            It is refused.
        """
        with self._here:
            self._require_open()
            with tempfile.TemporaryDirectory(dir=self.folder) as folder:
                return read_poses(keep_poses(name, content, Path(folder) / "poses"))

    def result(self, suffix: str) -> Result:
        """A file of the result: an animated GLB of several frames; a .zip where materials and textures go with it.

        Raises
        ------
        MeshError
            Nothing is posed: not yet, or it was refused.
        """
        outcome = self.outcome
        if outcome is None:
            raise MeshError("nothing is posed: choose a source and a target that can be")
        with self._here:
            self._require_open()
            with tempfile.TemporaryDirectory(dir=self.folder) as folder:
                out = Path(folder) / f"{outcome.file.path.stem}-posed{suffix}"
                left_out = _written(outcome, out)
                return Result(*_file_or_zip(out), [plain(line, self.folder) for line in left_out])

    def close(self) -> None:
        """End the work and remove the folder."""
        self._newest.close()
        with self._here:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _require_open(self) -> None:
        if not self.folder.is_dir():
            raise MeshError("this page is closed: load it again")

    def _pose(self, asked: Asked, stale: Callable[[], bool]) -> None:
        self._view.posing()
        try:
            self._transfers.run(asked, self.folder, stale, self._take)
        except Exception as error:
            self.outcome = None  # what was posed before is not of the meshes that are chosen now
            self._view.fail(plain(reason_of_failure(error), self.folder))

    def _take(self, outcome: Outcome) -> None:
        self.outcome = outcome
        self._view.show(outcome)


def _written(outcome: Outcome, out: Path) -> list[str]:
    """Write the result, and what lies beside it; what was left out, a line each."""
    frames = [frame.posed.vertices for frame in outcome.frames]
    if len(frames) > 1 and out.suffix == ".glb":
        write_animation(outcome.file, frames, out, frames_per_second=outcome.asked.switches.fps)
        return []
    return write_posed(outcome.file, frames[-1], out).left_out


def _file_or_zip(out: Path) -> tuple[str, bytes]:
    """The file, or a zip of it and of all that lies beside it."""
    files = sorted(path for path in out.parent.rglob("*") if path.is_file())
    if files == [out]:
        return out.name, out.read_bytes()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in files:
            archive.write(path, path.relative_to(out.parent))
    return f"{out.stem}.zip", packed.getvalue()


class Newest(Generic[Work]):
    """A thread that does the newest of what it is asked; a slider that moves asks far more often than it can do.

    ``work`` is given what was asked and a function that says whether something newer waits, so that long work can end.
    """

    def __init__(self, work: Callable[[Work, Callable[[], bool]], None]) -> None:
        self._work = work
        self._waiting: list[Work] = []
        self._changed = threading.Condition()
        self._is_open = True
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def ask(self, asked: Work) -> None:
        """Do this next, and nothing of what waited."""
        with self._changed:
            self._waiting[:] = [asked]
            self._changed.notify()

    def close(self) -> None:
        """Wait for what is being done; nothing more is done."""
        with self._changed:
            self._is_open = False
            self._changed.notify()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _is_stale(self) -> bool:
        return bool(self._waiting) or not self._is_open

    def _run(self) -> None:
        while (asked := self._next()) is not None:
            self._work(asked, self._is_stale)

    def _next(self) -> Work | None:
        with self._changed:
            self._changed.wait_for(self._is_stale)
            return self._waiting.pop() if self._is_open else None
