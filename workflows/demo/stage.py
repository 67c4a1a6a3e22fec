"""Source, target and result side by side in the browser: they turn together, each about itself, as the view turns."""

import asyncio
import math
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from datagen.common.arrays import Floats
from datagen.mesh.formats import format_of
from datagen.mesh.formats.surface import Material, Surface
from datagen.mesh.geometry import Mesh, standing_point
from training.viz.style import ROLE_COLORS

ROLES = {"source": "source: the pose", "target": "target: the body", "output": "result"}
_TALL, _GAP, _DISC = 1.7, 0.08, 0.6
"""Of the longest edge of a body's box, between two, of a disc; the scene has no unit."""
_FIELD = math.radians(32)
_ROOM = 1.3  # for the labels above and what is below
_TURNED, _RAISED = math.radians(-25), math.radians(8)
_MOST = 0.98  # of the vertices, for which room is made: a hand may reach over
_NARROW, _UNCOVERED = 576, 0.4  # pixels of a window over which the controls lie; what they leave of its height
_CHANGED = 0.12  # of the scene's size: a smaller change does not move the camera
_MOVED, _SETTLED = 1e-3, 0.5  # radians that count as a turn; seconds
_LYING = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)  # a quarter turn about X, of what has Z for its axis


@dataclass
class _Shown:
    """One body: the node that moves, its mesh, and how far it reaches from its axis."""

    node: viser.FrameHandle
    label: viser.LabelHandle
    disc: viser.CylinderHandle
    body: viser.MeshHandle | viser.GlbHandle | None = None
    faces: NDArray[np.integer] | None = None
    reach: float = 0.5
    height: float = _TALL


class Stage:
    """The three bodies of one person's view."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        client.scene.set_up_direction("+y")
        client.scene.configure_environment_map("studio", environment_intensity=0.35)
        client.scene.configure_default_lights(cast_shadow=False)  # they cost a weak graphics card most of its time
        self._shown = {role: self._placed(role) for role in ROLES}
        self._fitted = (0.0, 0.0, 0.0)
        self._azimuth = _TURNED
        client.camera.on_update(self._follow)

    def show(self, role: str, mesh: Mesh, *, unit: float, colors: Floats | None = None) -> None:
        """Show a body that stands with Y up; ``unit``: its length that is drawn as long as a body is.

        ``colors`` [v, 3] in [0, 1], or its role's.
        """
        its = self._shown[role]
        vertices = (mesh.vertices - standing_point(mesh.vertices)) * (_TALL / unit)
        its.reach = float(np.quantile(np.hypot(vertices[:, 0], vertices[:, 2]), _MOST))
        its.height = float(vertices[:, 1].max())
        if colors is not None:
            self._paint(role, Mesh(vertices, mesh.faces), colors)
        else:
            self._draw(role, Mesh(vertices, mesh.faces))
        its.label.position = (0.0, its.height + 0.06, 0.0)
        its.disc.scale = (_DISC * its.reach, _DISC * its.reach, 1.0)

    def say(self, role: str, words: str = "") -> None:
        """Put words behind a body's label."""
        self._shown[role].label.text = f"{ROLES[role]}{words and f' · {words}'}"

    def clear(self) -> None:
        """Take the bodies away."""
        for role, its in self._shown.items():
            if its.body is not None:
                its.body.remove()
            its.body = None
            self.say(role)

    def arrange(self) -> None:
        """Set the bodies beside each other, and the camera where it sees them all, if they or the window changed."""
        self._line_up()
        source, target, output = self._shown.values()
        width = 2 * (source.reach + target.reach + output.reach + _GAP)
        height = max(its.height for its in self._shown.values())
        now = (width, height, self._client.camera.aspect)
        if any(abs(new - old) > _CHANGED * new for new, old in zip(now, self._fitted, strict=True)):
            self._fitted = now
            self._look(width, height)

    def reset(self) -> None:
        """Look from where one looked first."""
        self._azimuth, self._fitted = _TURNED, (0.0, 0.0, 0.0)
        self.arrange()

    def _placed(self, role: str) -> _Shown:
        scene = self._client.scene
        node = scene.add_frame(f"/{role}", show_axes=False)
        label = scene.add_label(f"/{role}/label", ROLES[role], anchor="bottom-center", font_screen_scale=1.1)
        disc = scene.add_cylinder(
            f"/{role}/disc", radius=1.0, height=0.012, color=(232, 235, 239), position=(0.0, -0.008, 0.0),
            wxyz=_LYING, cast_shadow=False,
        )  # fmt: skip
        return _Shown(node, label, disc)

    def _draw(self, role: str, mesh: Mesh) -> None:
        its = self._shown[role]
        if isinstance(its.body, viser.MeshHandle) and its.faces is not None and np.array_equal(its.faces, mesh.faces):
            its.body.vertices = mesh.vertices.astype(np.float32)
            return
        red, green, blue = (round(255 * share) for share in ROLE_COLORS[role])
        its.faces = mesh.faces
        its.body = self._client.scene.add_mesh_simple(
            f"/{role}/body", mesh.vertices, mesh.faces, color=(red, green, blue), side="double", receive_shadow=False
        )

    def _paint(self, role: str, mesh: Mesh, colors: NDArray[np.floating]) -> None:
        """With a colour a vertex [v, 3], which only a GLB has here."""
        alpha = np.full((len(colors), 1), 255)
        rgba = np.concatenate([np.rint(255 * colors), alpha], axis=1).astype(np.uint8)
        faces, none = mesh.faces.astype(np.int64), np.zeros(len(mesh.faces), np.int64)
        surface = Surface(
            faces.ravel(), none + 3, colours=rgba, material_of=none, materials=(Material("errors", (1, 1, 1, 1)),)
        )
        encoded = format_of(".glb").build(surface, mesh.vertices.astype(np.float64), role, None)
        self._shown[role].body = self._client.scene.add_glb(f"/{role}/body", encoded.content, receive_shadow=False)

    def _line_up(self) -> None:
        """Along the view's own left and right, so that a turn of the view turns each body about itself."""
        source, target, output = self._shown.values()
        along = np.array([math.cos(self._azimuth), 0.0, -math.sin(self._azimuth)])
        middle = (output.reach - source.reach) / 2
        left, right = source.reach + target.reach + _GAP, target.reach + output.reach + _GAP
        for its, offset in ((source, -left), (target, 0.0), (output, right)):
            its.node.position = along * (offset - middle)

    def _look(self, width: float, height: float) -> None:
        camera = self._client.camera
        is_narrow = camera.aspect < 1 or camera.image_width < _NARROW
        free = _UNCOVERED if is_narrow else 1.0
        seen = max(width / max(camera.aspect, 0.2), height * _ROOM / free)
        near = seen / (2 * math.tan(_FIELD / 2))
        distance = near + max(its.reach for its in self._shown.values())
        flat = distance * math.cos(_RAISED)
        middle = height * 0.53 - seen * (1 - free) / 2
        with self._client.atomic():
            camera.fov = _FIELD
            camera.up_direction = (0.0, 1.0, 0.0)
            camera.position = (
                flat * math.sin(self._azimuth), middle + distance * math.sin(_RAISED), flat * math.cos(self._azimuth),
            )  # fmt: skip
            camera.look_at = (0.0, middle, 0.0)

    async def _follow(self, camera: viser.CameraHandle) -> None:
        """Line the bodies up with the view; on the event loop, so that moves are taken in their order."""
        if not self._fitted[2]:
            return  # nothing is shown yet, and the view is not ours
        away = camera.position - camera.look_at
        azimuth = math.atan2(away[0], away[2])
        if abs(azimuth - self._azimuth) > _MOVED:
            self._azimuth = azimuth
            self._line_up()
        if camera.aspect != self._fitted[2]:
            asyncio.get_running_loop().call_later(_SETTLED, self._fit, camera.aspect)

    def _fit(self, aspect: float) -> None:
        """Fit the view to a window that keeps its shape: panels open, and people drag."""
        if aspect == self._client.camera.aspect:
            self.arrange()
