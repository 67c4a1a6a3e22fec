"""The controls by which a person chooses one body: a made-up person or animal by sliders, or a file."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import viser

from datagen.common.errors import DsffnetError
from workflows.demo.bodies import (
    ANIMAL,
    ANIMALS_MISSING,
    DETAILS,
    LAST_POSE,
    PERSON,
    SPECIES,
    Figure,
    animals_are_there,
    parameter_names,
    random_figure,
)  # fmt: skip
from workflows.demo.transfers import Body
from workflows.demo.uploads import ACCEPTED, BYTE_LIMIT, FRAME_LIMIT

log = logging.getLogger(__name__)
KINDS = {"made-up person": PERSON, "made-up animal": ANIMAL}
OWN = "my own mesh"
_HINTS = {
    "gender": "0 male, 1 female", "age": "0 baby, 1/3 child, 2/3 young adult, 1 old", "muscle": "0 slight, 1 muscular",
    "weight": "0 thin, 1 heavy", "height": "0 short, 1 tall", "proportions": "0 ideal, 1 uncommon",
}  # fmt: skip
_SHOWN_PROPORTIONS = ("torso length", "neck length", "head size", "limb length", "limb girth", "tail length")


class BodyControls:
    """One tab: what stands as ``source`` or ``target``."""

    def __init__(
        self,
        gui: viser.GuiApi,
        first: Figure,
        keep: Callable[[str, bytes], tuple[Path, ...]],
        *,
        changed: Callable[[], None],
        failed: Callable[[str], None],
        takes: str,
    ) -> None:
        """``keep`` takes an upload, ``changed`` is called after every change, ``takes`` says what may be uploaded."""
        self._gui, self._keep, self._changed, self._failed = gui, keep, changed, failed
        self._random = np.random.default_rng()
        self._own: tuple[Path, ...] = ()
        self._is_setting = False
        kinds = [name for name, kind in KINDS.items() if kind == PERSON or animals_are_there()]
        self._kind = gui.add_dropdown("Body", (*kinds, OWN))
        self._detail = gui.add_dropdown("Mesh", tuple(DETAILS), hint="Anny's topologies; fewer vertices are faster")
        self._species = gui.add_dropdown("Species", SPECIES) if len(kinds) > 1 else None
        self._sliders = {PERSON: self._phenotypes(first), ANIMAL: self._proportions() if self._species else {}}
        self._pose = gui.add_slider(
            "Pose", 0, LAST_POSE, 1, int(first.pose), hint="0: at rest; the others are random, and none was in training"
        )
        self._another = gui.add_button("Another at random", icon=viser.Icon.DICE_5, color="gray")
        self._file = gui.add_folder("File")  # an upload button cannot be hidden by itself
        with self._file:
            self._about = gui.add_markdown(
                f"Choose a file, or drop it there: {takes}; up to {BYTE_LIMIT // 2**20} MB. It stays on the machine "
                "that runs this page, and goes when you leave."
            )
            self._upload = gui.add_upload_button("Choose a file", mime_type=ACCEPTED)
        self._missing = None if self._species else gui.add_markdown(ANIMALS_MISSING)
        self._listen()
        self._arrange()

    def body(self) -> Body | None:
        """What is chosen; None before a file is."""
        kind = KINDS.get(self._kind.value)
        if kind is None:
            return self._own or None
        values = tuple(float(slider.value) for slider in self._sliders[kind].values())
        if kind == PERSON:
            return Figure(kind, values, float(self._pose.value), DETAILS[self._detail.value])
        given = dict(zip(self._sliders[kind], values, strict=True))
        factors = (given.get(name, 1.0) for name in parameter_names(kind))
        assert self._species is not None
        return Figure(kind, (float(SPECIES.index(self._species.value)), *factors), float(self._pose.value))

    def draw(self) -> None:
        """Another body at random, in another pose."""
        kind = KINDS[self._kind.value]
        figure = random_figure(kind, self._random, DETAILS[self._detail.value])
        self._is_setting = True
        if self._species and kind == ANIMAL:
            self._species.value = SPECIES[int(figure.parameters[0])]
        drawn = dict(zip(parameter_names(kind), figure.parameters[-len(parameter_names(kind)) :], strict=True))
        for name, slider in self._sliders[kind].items():
            slider.value = drawn[name]
        self._pose.value = int(figure.pose)
        self._is_setting = False
        self._changed()

    def _phenotypes(self, first: Figure) -> dict[str, viser.GuiSliderHandle[float]]:
        names = zip(parameter_names(PERSON), first.parameters, strict=True)
        return {
            name: self._gui.add_slider(name.capitalize(), 0.0, 1.0, 0.01, value, hint=_HINTS.get(name))
            for name, value in names
        }

    def _proportions(self) -> dict[str, viser.GuiSliderHandle[float]]:
        return {
            name: self._gui.add_slider(name.capitalize(), 0.8, 1.2, 0.01, 1.0, hint="times the species' own")
            for name in parameter_names(ANIMAL)
            if name in _SHOWN_PROPORTIONS
        }

    def _listen(self) -> None:
        sliders = [*self._sliders[PERSON].values(), *self._sliders[ANIMAL].values(), self._pose]
        for handle in (*sliders, self._detail, *([self._species] if self._species else [])):
            handle.on_update(lambda _: self._is_setting or self._changed())
        self._kind.on_update(lambda _: self._choose_kind())
        self._another.on_click(lambda _: self.draw())
        self._upload.on_upload(lambda _: self._take(self._upload.value))

    def _choose_kind(self) -> None:
        self._arrange()
        if self.body() is not None:
            self._changed()

    def _arrange(self) -> None:
        """Show what belongs to the kind of body that is chosen."""
        kind = KINDS.get(self._kind.value)
        for each, sliders in self._sliders.items():
            for slider in sliders.values():
                slider.visible = kind == each
        self._detail.visible = kind == PERSON
        if self._species:
            self._species.visible = kind == ANIMAL
        self._pose.visible = self._another.visible = kind is not None
        self._file.visible = kind is None

    def _take(self, file: viser.UploadedFile) -> None:
        try:
            self._own = self._keep(file.name, file.content)
        except DsffnetError as error:
            self._failed(str(error))
            return
        except Exception as error:
            log.warning("an upload failed", exc_info=True)
            self._failed(f"it cannot be read: {error!r}")
            return
        frames = f", {len(self._own)} frames of at most {FRAME_LIMIT}" if len(self._own) > 1 else ""
        self._about.content = f"**{self._own[0].name}**{frames}. Another file takes its place."
        self._changed()
