"""Where a person gives a file: a button to choose it, what became of it, which of its geometries and animations are
taken."""

import logging
from collections.abc import Callable
from pathlib import Path

import viser

from datagen.characters.motion import animation_names
from datagen.common.errors import DsffnetError, NotOneBodyError
from datagen.mesh.files import geometry_names
from workflows.demo.transfers import read
from workflows.demo.uploads import BYTE_LIMIT, FRAME_LIMIT

log = logging.getLogger(__name__)
_LISTED = 24  # geometries and animations that are offered; of more, dsffnet transfer chooses
_AT_REST = "none: at rest"


class FileControls:
    """A folder of controls with a place for a file; ``failed`` is told in a line why one is not taken."""

    def __init__(
        self,
        gui: viser.GuiApi,
        takes: str,
        *,
        accepted: str,
        take: Callable[[str, bytes], str],
        failed: Callable[[str], None],
    ) -> None:
        """``take`` is given a name and a content, and says what it is; ``takes`` says what may be uploaded."""
        self._take, self._failed = take, failed
        self.folder = gui.add_folder("File")  # an upload button cannot be hidden by itself
        with self.folder:
            self.about = gui.add_markdown(
                f"Choose a file, or drop it there: {takes}; up to {BYTE_LIMIT // 2**20} MB. It stays on the machine "
                "that runs this page, and goes when you leave."
            )
            self._upload = gui.add_upload_button("Choose a file", mime_type=accepted)
        self._upload.on_upload(lambda _: self._receive(self._upload.value))

    def _receive(self, file: viser.UploadedFile) -> None:
        try:
            said = self._take(file.name, file.content)
        except DsffnetError as error:
            self._failed(str(error))
        except Exception as error:
            log.warning("an upload failed", exc_info=True)
            self._failed(f"it cannot be read: {error!r}")
        else:
            self.about.content = f"{said}. Another file takes its place."


class MeshFileControls(FileControls):
    """A mesh of one's own, or frames of one: a box to tick for each of its geometries, and its animations."""

    def __init__(
        self,
        gui: viser.GuiApi,
        takes: str,
        *,
        accepted: str,
        keep: Callable[[str, bytes], tuple[Path, ...]],
        changed: Callable[[], None],
        failed: Callable[[str], None],
        plays: bool,
    ) -> None:
        """``keep`` takes an upload, ``changed`` is called after every change; ``plays``: animations are offered."""
        super().__init__(gui, takes, accepted=accepted, take=self._keep_mesh, failed=failed)
        self._gui, self._keep, self._changed, self._plays = gui, keep, changed, plays
        self._files: tuple[Path, ...] = ()
        self._all: set[str] = set()  # what is taken where nothing is chosen
        self._boxes: dict[str, viser.GuiCheckboxHandle] = {}
        self._choice: viser.GuiFolderHandle | None = None
        self._animation: viser.GuiDropdownHandle[str] | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """What was given; nothing before, and while no geometry is chosen."""
        return self._files if not self._boxes or self._ticked else ()

    @property
    def geometries(self) -> tuple[str, ...]:
        """Names of those that are taken; none for all that make one body."""
        return () if set(self._ticked) == self._all else self._ticked

    @property
    def animation(self) -> str | None:
        """Name of the animation that is played; None for the mesh at rest."""
        chosen = self._animation.value if self._animation else _AT_REST
        return None if chosen == _AT_REST else chosen

    @property
    def _ticked(self) -> tuple[str, ...]:
        return tuple(name for name, box in self._boxes.items() if box.value)

    def _keep_mesh(self, name: str, content: bytes) -> str:
        files = self._keep(name, content)
        names, self._all, remark = _geometries(files[0])
        self._files = files
        self._offer(names)
        self._offer_animations(animation_names(files[0]) if self._plays and len(files) == 1 else ())
        if remark:
            self._failed(remark)
        self._changed()
        frames = f", {len(files)} frames of at most {FRAME_LIMIT}" if len(files) > 1 else ""
        return f"**{files[0].name}**{frames}"

    def _offer(self, names: tuple[str, ...]) -> None:
        """A box for each geometry, in the place of the last file's."""
        if self._choice:
            self._choice.remove()
        self._choice, self._boxes = None, {}
        if not names:
            return
        with self.folder:
            self._choice = self._gui.add_folder("Geometries")
        with self._choice:
            for name in names:
                self._boxes[name] = self._gui.add_checkbox(name, name in self._all)
                self._boxes[name].on_update(lambda _: self._changed())

    def _offer_animations(self, names: tuple[str, ...]) -> None:
        """A list of them, the first one chosen, in the place of the last file's."""
        if self._animation:
            self._animation.remove()
        self._animation = None
        if not names:
            return
        with self.folder:
            self._animation = self._gui.add_dropdown("Animation", (*names[:_LISTED], _AT_REST))
        self._animation.on_update(lambda _: self._changed())


def _geometries(path: Path) -> tuple[tuple[str, ...], set[str], str]:
    """What is offered to choose among, what is taken at first, and what is wrong with taking all."""
    names = geometry_names(path)
    try:
        taken, remark = set(read(path).geometries or names), ""
    except NotOneBodyError as error:
        taken, remark = set(), str(error)
    if len(names) < 2 or (len(names) > _LISTED and not remark):
        return (), set(), ""
    return names[:_LISTED], taken, remark
