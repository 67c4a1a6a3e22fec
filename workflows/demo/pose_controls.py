"""The controls of a made-up body's pose: a random one, one of a person's own file, and joints turned by hand."""

import threading
from collections.abc import Callable

import viser

from workflows.demo.file_controls import FileControls
from workflows.demo.poses import LAST_POSE, TURNED, Pose, PoseFile, Turns
from workflows.demo.uploads import POSES

_RANDOM, _OWN = "random", "my own (.npz)"
_TAKES = "`.npz` of AMASS, or of `poses` and `joints`"
_AXES = {
    "X": "about the axis to the body's left: forwards and backwards",
    "Y": "about the vertical axis: to the side",
    "Z": "about the axis to the front: sideways",
}


class PoseControls:
    """A slider of poses; of the source, if it is a person, also joints and a file of poses (``keep`` takes it)."""

    def __init__(
        self,
        gui: viser.GuiApi,
        first: Pose,
        *,
        is_source: bool,
        keep: Callable[[str, bytes], PoseFile],
        changed: Callable[[], None],
        failed: Callable[[str], None],
    ) -> None:
        """``changed`` is called after every change."""
        self._gui, self._is_source, self._keep, self._changed = gui, is_source, keep, changed
        self._is_setting = False
        self._from = gui.add_dropdown("Poses", (_RANDOM, _OWN), visible=is_source)
        self._number = gui.add_slider(
            "Pose", 0, LAST_POSE, 1, int(first.number), hint="0: at rest; the others are random, none was in training"
        )
        self._files = FileControls(gui, _TAKES, accepted=POSES, take=self._take, failed=failed) if is_source else None
        self._poses: PoseFile | None = None
        self._place: viser.GuiSliderHandle[int] | None = None
        self._turns = JointControls(gui, changed) if is_source else None
        self._number.on_update(lambda _: None if self._is_setting else changed())
        self._from.on_update(lambda _: self._choose_source())
        self.arrange(is_shown=True, is_person=True)

    @property
    def pose(self) -> Pose:
        """What is chosen; random poses until there is a file."""
        turns = self._turns.turns if self._turns and self._is_person else ()
        if self._plays_file and self._place:
            return Pose(float(self._place.value), self._poses, turns)
        return Pose(float(self._number.value), turns=turns)

    @pose.setter
    def pose(self, pose: Pose) -> None:
        """A random pose, without being told as a change."""
        self._is_setting = True
        self._number.value = int(pose.number)
        self._is_setting = False

    def arrange(self, *, is_shown: bool, is_person: bool) -> None:
        """Show what belongs to a made-up body, if one ``is_shown``."""
        self._is_shown, self._is_person = is_shown, is_person
        own = is_shown and self._plays_file
        self._number.visible = is_shown and not own
        self._from.visible = is_shown and is_person and self._is_source
        if self._files:
            self._files.folder.visible = own
        if self._turns:
            self._turns.folder.visible = is_shown and is_person

    @property
    def _plays_file(self) -> bool:
        return self._is_person and self._from.value == _OWN

    def _choose_source(self) -> None:
        self.arrange(is_shown=self._is_shown, is_person=self._is_person)
        self._changed()

    def _take(self, name: str, content: bytes) -> str:
        assert self._files
        self._poses = poses = self._keep(name, content)
        if self._place:
            self._place.remove()
        with self._files.folder:
            last = max(poses.count - 1, 1)
            self._place = self._gui.add_slider(
                "Pose", 0, last, 1, 0, hint="its place in the file", disabled=poses.count == 1
            )
        self._place.on_update(lambda _: self._changed())
        self._changed()
        return f"**{poses.name}**, {poses.count:,} poses"


class JointControls:
    """A joint to choose, and the degrees by which it is turned further, kept for each joint."""

    def __init__(self, gui: viser.GuiApi, changed: Callable[[], None]) -> None:
        """``changed`` is called after every change."""
        self._changed, self._is_setting, self._lock = changed, False, threading.RLock()
        self._degrees = {joint: [0.0, 0.0, 0.0] for joint in TURNED}
        self._shown = "left shoulder"
        self.folder = gui.add_folder("Turn joints", expand_by_default=False)
        with self.folder:
            self._joint = gui.add_dropdown("Joint", tuple(TURNED), initial_value=self._shown)
            self._sliders = [
                gui.add_slider(f"{axis} (degrees)", -180.0, 180.0, 1.0, 0.0, hint=hint) for axis, hint in _AXES.items()
            ]
            reset = gui.add_button("Reset all joints", icon=viser.Icon.ROTATE, color="gray")
        self._joint.on_update(lambda _: self._show(self._joint.value))
        for place, slider in enumerate(self._sliders):
            slider.on_update(lambda _, place=place: self._turn(place))
        reset.on_click(lambda _: self._reset())

    @property
    def turns(self) -> Turns:
        """Joints of SMPL that are turned, and their degrees about X, Y, Z."""
        return tuple((TURNED[joint], (x, y, z)) for joint, (x, y, z) in self._degrees.items() if x or y or z)

    def _turn(self, place: int) -> None:
        with self._lock:  # an angle that comes as the joint changes is that of the joint whose sliders were shown
            if self._is_setting:
                return
            self._degrees[self._shown][place] = float(self._sliders[place].value)
        self._changed()

    def _show(self, joint: str) -> None:
        with self._lock:
            self._shown, self._is_setting = joint, True
            for slider, value in zip(self._sliders, self._degrees[joint], strict=True):
                slider.value = value
            self._is_setting = False

    def _reset(self) -> None:
        with self._lock:
            for degrees in self._degrees.values():
                degrees[:] = 0.0, 0.0, 0.0
            self._show(self._shown)
        self._changed()
