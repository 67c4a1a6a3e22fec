"""The controls by which a person chooses one body: a made-up person or animal by sliders, or a file."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import viser

from datagen.characters import cc0_animals
from workflows.demo.bodies import (
    ANIMALS_MISSING,
    BARE,
    CLOTHES,
    DETAILS,
    SPECIES,
    Figure,
    parameter_names,
    random_figure,
)  # fmt: skip
from workflows.demo.file_controls import MeshFileControls
from workflows.demo.pose_controls import PoseControls
from workflows.demo.poses import ANIMAL, PERSON, Pose, PoseFile
from workflows.demo.transfers import Body
from workflows.demo.uploads import ACCEPTED

KINDS = {"made-up person": PERSON, "made-up animal": ANIMAL}
OWN = "my own mesh"
_HINTS = {
    "gender": "0 male, 1 female", "age": "0 baby, 1/3 child, 2/3 young adult, 1 old", "muscle": "0 slight, 1 muscular",
    "weight": "0 thin, 1 heavy", "height": "0 short, 1 tall", "proportions": "0 ideal, 1 uncommon",
}  # fmt: skip
_FORMATS = "OBJ, PLY, GLB, OFF, STL"
_TAKES = {
    True: f"{_FORMATS} (an animated GLB is played), or a .zip of frames",
    False: f"{_FORMATS}, or a .zip with its materials",
}
"""What may be uploaded as source, and as target."""
_SHOWN_PROPORTIONS = ("torso length", "neck length", "head size", "limb length", "limb girth", "tail length")


class BodyControls:
    """One tab: what stands as source or as target."""

    def __init__(
        self,
        gui: viser.GuiApi,
        first: Figure,
        keep: Callable[[str, bytes], tuple[Path, ...]],
        *,
        is_source: bool,
        keep_poses: Callable[[str, bytes], PoseFile],
        changed: Callable[[], None],
        failed: Callable[[str], None],
    ) -> None:
        """The source is offered poses and what is played, the target clothes.

        ``keep`` takes an upload, ``keep_poses`` one of poses; ``changed`` is called after every change.
        """
        self._gui, self._changed = gui, changed
        self._random = np.random.default_rng()
        self._is_setting = False
        kinds = [name for name, kind in KINDS.items() if kind == PERSON or cc0_animals.are_there()]
        self._kind = gui.add_dropdown("Body", (*kinds, OWN))
        self._detail = gui.add_dropdown("Mesh", tuple(DETAILS), hint="Anny's topologies; fewer vertices are faster")
        self._outfit = None
        if not is_source:
            self._outfit = gui.add_dropdown("Outfit", CLOTHES, hint="people in clothes stand at rest")
        self._species = gui.add_dropdown("Species", SPECIES) if len(kinds) > 1 else None
        self._sliders = {PERSON: self._phenotypes(first), ANIMAL: self._proportions() if self._species else {}}
        self._poses = PoseControls(
            gui, first.pose, is_source=is_source, keep=keep_poses, changed=changed, failed=failed
        )
        self._another = gui.add_button("Another at random", icon=viser.Icon.DICE_5, color="gray")
        self._file = MeshFileControls(
            gui, _TAKES[is_source], accepted=ACCEPTED, keep=keep, changed=changed, failed=failed, plays=is_source
        )
        self._missing = None if self._species else gui.add_markdown(ANIMALS_MISSING)
        self._listen()
        self._arrange()

    def body(self) -> Body | None:
        """What is chosen; None before a file is."""
        kind = KINDS.get(self._kind.value)
        if kind is None:
            return self._file.files or None
        values = tuple(float(slider.value) for slider in self._sliders[kind].values())
        if kind == PERSON:
            pose = Pose() if self._is_clothed else self._poses.pose
            return Figure(kind, values, pose, DETAILS[self._detail.value], self._outfit.value if self._outfit else BARE)
        given = dict(zip(self._sliders[kind], values, strict=True))
        factors = (given.get(name, 1.0) for name in parameter_names(kind))
        assert self._species is not None
        return Figure(kind, (float(SPECIES.index(self._species.value)), *factors), self._poses.pose)

    @property
    def geometries(self) -> tuple[str, ...]:
        """Of a mesh of one's own, those that are taken; none for all."""
        return () if self._kind.value in KINDS else self._file.geometries

    @property
    def animation(self) -> str | None:
        """Of a mesh of one's own, the animation that is played."""
        return None if self._kind.value in KINDS else self._file.animation

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
        self._poses.pose = figure.pose
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
        dropdowns = [each for each in (self._detail, self._species) if each]
        for handle in (*self._sliders[PERSON].values(), *self._sliders[ANIMAL].values(), *dropdowns):
            handle.on_update(lambda _: self._is_setting or self._changed())
        if self._outfit:
            self._outfit.on_update(lambda _: self._choose_kind())
        self._kind.on_update(lambda _: self._choose_kind())
        self._another.on_click(lambda _: self.draw())

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
        if self._outfit:
            self._outfit.visible = kind == PERSON
        if self._species:
            self._species.visible = kind == ANIMAL
        self._poses.arrange(is_shown=kind is not None and not self._is_clothed, is_person=kind == PERSON)
        self._another.visible = kind is not None
        self._file.folder.visible = kind is None

    @property
    def _is_clothed(self) -> bool:
        return KINDS.get(self._kind.value) == PERSON and self._outfit is not None and self._outfit.value != BARE
