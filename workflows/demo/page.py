"""The page that one person sees: controls at the side, three bodies, and the result's captions."""

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import viser

from datagen.common.errors import DsffnetError
from training.viz.style import error_colors
from workflows.demo.bodies import Figure, random_figure
from workflows.demo.captions import about, dressed_colors, label, legend, plain
from workflows.demo.controls import BodyControls
from workflows.demo.poses import PERSON
from workflows.demo.session import Session
from workflows.demo.stage import Stage
from workflows.demo.transfers import Asked, Outcome, Switches, Transfers, clash_of

_STYLE = """<style>
input[type=file] { display: block !important; width: calc(100% - 20px); margin: 0 10px 6px; padding: 14px 10px;
  border: 1.5px dashed #b9c0ca; border-radius: 6px; background: #f5f6f8; font: 13px system-ui, sans-serif;
  color: #5d6676; box-sizing: border-box; cursor: pointer; }
input[type=file] ~ button { display: none; }
</style>"""
_AS_FOUND, _WITHOUT = "as found", "none"
_SMOOTH_FRAMES = 7


class Page:
    """One person's page; see :class:`workflows.demo.session.View`."""

    def __init__(self, client: viser.ClientHandle, folder: Path, transfers: Transfers) -> None:
        self._client, self._transfers = client, transfers
        self.session = Session(folder, transfers, self)
        self._closed = threading.Event()
        try:
            self._build()
        except BaseException:
            self.close()
            raise

    def _build(self) -> None:
        client = self._client
        self._stage = Stage(client)
        self._drawing = threading.RLock()
        self._frame = 0
        gui = client.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(47, 98, 181))
        gui.set_panel_label("dsffnet · pose transfer")
        gui.main_panel.dock_right()
        gui.add_html(_STYLE)
        self._status = gui.add_markdown("")
        self._progress = gui.add_progress_bar(0.0, visible=False)
        self._add_tabs()
        self._add_result()
        threading.Thread(target=self._play, daemon=True).start()
        self.ask()

    def ask(self) -> None:
        """Pose what the controls say."""
        source, target = self._source.body(), self._target.body()
        if source is None or target is None:
            return
        clash = clash_of(source, target, self._switches())
        if clash:
            self._status.content = f"**Up and Front.** {clash}"
            return
        is_sequence = not isinstance(source, Figure) and (len(source) > 1 or self._source.animation is not None)
        moving = self._moving.value or is_sequence
        self.session.ask(Asked(source, target, self._switches(), moving=moving, draped=self._errors.value))

    def posing(self) -> None:
        """Say that a transfer has begun."""
        self._stage.say("output", "posing …")
        self._status.content = "posing …"

    def show(self, outcome: Outcome) -> None:
        """Show the frame that is done; the others are played."""
        self._progress.visible = len(outcome.frames) < outcome.count
        self._progress.value = 100 * len(outcome.frames) / outcome.count
        if len(outcome.frames) == 1:
            self._offer_downloads(True)
            self._draw(outcome)
            self._stage.arrange()
        self._status.content = about(outcome, self.session.folder)

    def fail(self, message: str) -> None:
        """Say what cannot be posed; what was shown is of other meshes, and goes."""
        with self._drawing, self._client.atomic():
            self._stage.clear()
            self._legend.content = ""
        self._offer_downloads(False)
        self._progress.visible = False
        self._refuse(message)

    def _refuse(self, message: str) -> None:
        """Say what is not taken."""
        self._status.content = f"**Not posed.** {message}"
        self._client.add_notification("That cannot be posed", message, color="red", auto_close_seconds=20)

    def close(self) -> None:
        """End everything of this page, and its folder."""
        self._closed.set()
        self.session.close()

    def _add_tabs(self) -> None:
        gui, random = self._client.gui, np.random.default_rng()
        tabs = gui.add_tab_group()
        with tabs.add_tab("Source", viser.Icon.RUN):
            gui.add_markdown("Gives the **pose**.")
            self._source = self._controls("source", random_figure(PERSON, random))
        with tabs.add_tab("Target", viser.Icon.USER):
            gui.add_markdown("Gives the **body**; its own pose does not matter.")
            self._target = self._controls("target", random_figure(PERSON, random))
        with tabs.add_tab("Options", viser.Icon.ADJUSTMENTS):
            self._add_switches()

    def _controls(self, role: str, first: Figure) -> BodyControls:
        def keep(name: str, content: bytes) -> tuple[Path, ...]:
            return self.session.keep(role, name, content)

        return BodyControls(
            self._client.gui, first, keep, is_source=role == "source", keep_poses=self.session.keep_poses,
            changed=self.ask, failed=lambda error: self._refuse(plain(error, self.session.folder)),
        )  # fmt: skip

    def _add_switches(self) -> None:
        gui, own = self._client.gui, self._transfers.weights is None
        self._refine = gui.add_checkbox(
            "Refine", False, hint="pulls the surface back to the target's: its edges get the lengths they had there"
        )
        self._smooth = gui.add_checkbox(
            "Smooth", False, hint=f"smooths a sequence in time, over {_SMOOTH_FRAMES} frames; one mesh stays as it is"
        )
        self._align = gui.add_checkbox(
            "Align", False, hint="finds how each mesh stands", visible=not self._transfers.finds_standing
        )
        self._force = gui.add_checkbox(
            "Force",
            False,
            hint="poses a person like an animal, or an animal like a person, which is refused otherwise: a pose of the "
            "one says nothing of the other",
            visible=own,
        )
        self._project = gui.add_dropdown(
            "Project",
            (_WITHOUT, "human", "animals"),
            hint="fits the target's rigid parts, as these weights see them, to the output: each keeps its shape",
            visible=not own,
        )
        axes = (_AS_FOUND, "X", "Y", "Z", "-X", "-Y", "-Z")
        self._up = gui.add_dropdown("Up", axes, hint="where the heads of your meshes are")
        self._front = gui.add_dropdown("Front", axes, hint="where your meshes face")
        for handle in (self._refine, self._smooth, self._align, self._force, self._project, self._up, self._front):
            handle.on_update(lambda _: self.ask())

    def _add_result(self) -> None:
        gui = self._client.gui
        with gui.add_folder("Result"):
            self._moving = gui.add_checkbox("Play", False, hint="a made-up source, through its next poses or its file")
            self._errors = gui.add_checkbox("Error map", False, hint="known where both bodies are made up")
            self._legend = gui.add_html("")
            self._downloads = [
                gui.add_button(f"Download {kind}", icon=viser.Icon.DOWNLOAD, disabled=True) for kind in ("GLB", "OBJ")
            ]
            view = gui.add_button("Reset the view", icon=viser.Icon.VIEWFINDER, color="gray")
        self._moving.on_update(lambda _: self.ask())
        self._errors.on_update(lambda _: self._choose_errors())
        for suffix, button in zip((".glb", ".obj"), self._downloads, strict=True):
            button.on_click(self._downloading(suffix))
        view.on_click(lambda _: self._stage.reset())

    def _switches(self) -> Switches:
        up, front = (None if axis.value == _AS_FOUND else axis.value for axis in (self._up, self._front))
        return Switches(
            refine=self._refine.value,
            align=self._align.value,
            force=self._force.value,
            project=None if self._project.value == _WITHOUT else self._project.value,
            up=up,
            front=front,
            smooth=str(_SMOOTH_FRAMES) if self._smooth.value else "0",
            source_geometry=self._source.geometries,
            target_geometry=self._target.geometries,
            animation=self._source.animation,
        )

    def _downloading(self, suffix: str) -> Callable[[object], None]:
        def download(_: object) -> None:
            try:
                result = self.session.result(suffix)
            except DsffnetError as error:
                self._client.add_notification("Nothing to download", plain(error, self.session.folder), color="red")
            else:
                self._client.send_file_download(result.name, result.content, save_immediately=True)
                if result.left_out:
                    self._client.add_notification("Left out", "\n".join(result.left_out), color="yellow")

        return download

    def _offer_downloads(self, is_there: bool) -> None:
        for button in self._downloads:
            button.disabled = not is_there

    def _choose_errors(self) -> None:
        outcome = self.session.outcome
        if self._errors.value and outcome is not None and outcome.waits_for_draping:
            self.ask()
        else:
            self._draw_again()

    def _draw_again(self) -> None:
        with self._drawing:
            outcome = self.session.outcome
            if outcome is not None:
                self._draw(outcome)

    def _draw(self, outcome: Outcome) -> None:
        with self._drawing, self._client.atomic():
            frame = outcome.frames[place_of(self._frame, outcome)]
            garments = outcome.garments
            sizes = {role: float(np.ptp(getattr(frame, role).vertices, axis=0).max()) for role in ("source", "target")}
            errors = frame.errors if self._errors.value else None
            worst = float(np.percentile(errors, 99)) if errors is not None else 1.0
            self._stage.show("source", frame.source, unit=sizes["source"])
            self._stage.show("target", frame.target, unit=sizes["target"], colors=dressed_colors("target", garments))
            colors = dressed_colors("output", garments) if errors is None else error_colors(errors, worst)
            self._stage.show("output", frame.output, unit=sizes["target"], colors=colors)
            self._stage.say("output", label(outcome, frame))
            self._legend.content = legend(outcome, frame, worst, shown=self._errors.value)

    def _play(self) -> None:
        """Show the frames of a sequence, one after the other; of a walk also backwards."""
        while not self._closed.wait(1 / Switches.fps):
            with self._drawing:  # else a frame of what was could come after the first of what is
                outcome = self.session.outcome
                if outcome is not None and len(outcome.frames) > 1:
                    self._frame += 1
                    self._draw(outcome)


def place_of(frame: int, outcome: Outcome) -> int:
    """Which frame of a sequence comes as the so manieth; the way between random poses is played back and forth."""
    count, source = len(outcome.frames), outcome.asked.source
    if count > 1 and isinstance(source, Figure) and not source.pose.file:
        return abs((frame + count - 1) % (2 * count - 2) - (count - 1))
    return frame % count
