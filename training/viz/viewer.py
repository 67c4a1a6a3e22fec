"""An interactive page of transfers, by one method or several: one HTML file that needs neither network nor server.

What is embedded, little-endian in base64: positions as uint16 between the corners of each mesh's box (off by at most
half a step, ``box / 65535 / 2``: 15 micrometres for a body of 2 m), triangles as uint16 or uint32 and once for all
meshes that share them, errors as uint16 levels of the largest, textures as JPEG once for all meshes that have them, and
of a sequence the positions of every frame, eight bytes a vertex. The drawing code is assets/viewer.js, bundled with
three.js.
"""

import base64
import hashlib
import html
import io
import json
import os
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

from datagen.common.arrays import Floats, Integers
from datagen.common.files import write_atomically
from datagen.common.printable import printable
from datagen.mesh.geometry import Mesh
from training.viz.look import Look
from training.viz.render.lighting import ground_shadow, openness
from training.viz.style import ERROR_COLORS, ROLE_COLORS, method_colors
from training.viz.transfer_example import (
    ERROR_UNIT,
    Comparison,
    best_of,
    error_limit,
    errors_of,
    in_view,
    look_at,
    methods_in,
    output_of,
    placed,
    placed_frames,
)

_LEVELS = 65535
_GROUND_EVERY = 2  # the page keeps every second cell of the ground's shadow
MOTION_LIMIT = 40_000_000
"""Bytes at most of the frames of a sequence on a page."""
_FRAME_BYTES = 2 * 3_300  # but for positions: the shadows below source and output, and names
_JPEG = 88


def write_viewer(
    examples: Sequence[Comparison],
    path: str | os.PathLike[str],
    *,
    title: str,
) -> Path:
    """Write a page with source, target, outputs, ground truth and errors of every example, to be turned with the mouse.

    All panels of the page turn together. Of several methods each can be hidden. Without a truth there are no errors.
    The page works from a file, from a server, and inside a frame; it loads nothing. Names and titles are shown as
    plain text.

    Parameters
    ----------
    examples : sequence of Comparison
        A mesh's ``name`` attribute, where it has one, is shown under its panel; under an output, its metrics.
    path : path of the HTML to write
    title : str
        Heading of the page.

    Returns
    -------
    Path
        The path of the page.

    Raises
    ------
    ValueError
        If there is no example, a vertex is not finite, or an output and its truth differ in shape.
    """
    if not examples:
        raise ValueError("write_viewer needs at least one example")
    payload = viewer_payload(examples)
    licence = f"/*\n{_asset('THREE-LICENSE.txt')}*/\n"  # a page is a copy of three.js, so its licence goes along
    page = Template(_asset("viewer.html")).substitute(
        title=html.escape(printable(title)),
        style=_asset("viewer.css"),
        data=_inert_json(_printable(payload)),
        bundle=licence + _asset("viewer.bundle.js"),
    )
    write_atomically(Path(path), page.encode())
    return Path(path)


def viewer_payload(examples: Sequence[Comparison]) -> dict[str, Any]:
    """Return what the page is given: meshes standing on the ground, errors, colours and the first views."""
    triangles: dict[str, dict[str, str]] = {}
    looks: dict[str, dict[str, Any]] = {}
    methods = methods_in(examples)
    return {
        "examples": [_example(example, triangles, looks) for example in examples],
        "looks": looks,
        "methods": [{"name": name, "color": color} for name, color in method_colors(methods).items()],
        "faces": triangles,
        "colors": dict(ROLE_COLORS),
        "error": {
            "unit": ERROR_UNIT,
            "limit": error_limit(examples),
            "colors": np.rint(255 * ERROR_COLORS).astype(int).tolist(),
        },
    }


def _example(
    comparison: Comparison, triangles: dict[str, dict[str, str]], looks: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    meshes, errors = placed(comparison), errors_of(comparison)
    originals = comparison.meshes()
    embedded = {
        name: _mesh(mesh, str(getattr(originals[name], "name", "")), triangles)
        | {"look": _shared_look(look_at(originals[name]), mesh, looks)}
        for name, mesh in meshes.items()
    }
    frames = list(placed_frames(comparison))
    boxes = {output_of(f"in frame {number}"): _box(frame) for number, frame in enumerate(frames)}
    return {
        "title": comparison.title,
        "source": embedded["source"],
        "target": embedded["target"],
        "truth": embedded.get("truth"),
        "outputs": {name: embedded[output_of(name)] for name in comparison.outputs},
        "metrics": {name: comparison.metrics.get(name, "") for name in comparison.outputs},
        "errors": {name: _errors(values) for name, values in errors.items()},
        "best": best_of(errors),
        "view": _view(meshes | boxes),
        "motion": _motion(comparison, frames, triangles),
    }


def frames_apart(count: int, vertices: int) -> int:
    """Return every how many of so many frames a page can show, whose source and output have so many ``vertices``."""
    return max(1, -(-count * (8 * vertices + _FRAME_BYTES) // MOTION_LIMIT))


def _motion(
    comparison: Comparison, frames: Sequence[tuple[Mesh, Mesh]], triangles: dict[str, dict[str, str]]
) -> dict[str, Any] | None:
    """Return the frames by role, without what does not change."""
    if comparison.motion is None:
        return None
    found: dict[str, Any] = {"rate": comparison.motion.rate}
    for place, role in enumerate(("source", "output")):
        names = [str(getattr(frame[place], "name", "")) for frame in comparison.motion.frames]
        found[role] = [
            _shape(frame[place], triangles) | {"name": name} for frame, name in zip(frames, names, strict=True)
        ]
    return found


def _box(meshes: Sequence[Mesh]) -> Mesh:
    """The corners of the box around some meshes, as a mesh without faces."""
    low, high = (extreme([extreme(mesh.vertices, axis=0) for mesh in meshes], axis=0) for extreme in (np.min, np.max))
    return Mesh(np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T, np.empty((0, 3), np.int64))


def _errors(errors: Floats) -> dict[str, Any]:
    """Return a method's errors [v], and their mean and maximum in words."""
    largest = float(errors.max())
    step = max(largest, 1e-12) / _LEVELS
    return {
        "levels": _base64(np.rint(errors / step).astype("<u2")),
        "step": step,
        "mean": float(errors.mean()),
        "text": f"mean {errors.mean():.3g}, max {largest:.3g} {ERROR_UNIT}",
    }


def _mesh(mesh: Mesh, name: str, triangles: dict[str, dict[str, str]]) -> dict[str, Any]:
    vertices, faces = mesh.vertices, np.asarray(mesh.faces, np.int64)
    light = np.rint(255 * np.clip(openness(vertices, faces), 0, 1)).astype(np.uint8)
    return _shape(mesh, triangles) | {"name": name, "openness": _base64(light)}


def _shape(mesh: Mesh, triangles: dict[str, dict[str, str]]) -> dict[str, Any]:
    """Return positions, triangles and the shadow on the ground."""
    vertices, faces = mesh.vertices, np.asarray(mesh.faces, np.int64)
    low = vertices.min(0)
    step = np.maximum(np.ptp(vertices, axis=0), 1e-12) / _LEVELS
    shadow, corner, side = ground_shadow(vertices, faces)
    return {
        "positions": _base64(np.rint((vertices - low) / step).astype("<u2")),
        "low": low.tolist(),
        "step": step.tolist(),
        "faces": _shared_faces(faces, len(vertices), triangles),
        "ground": {
            "shadow": _base64(np.rint(255 * shadow[::_GROUND_EVERY, ::_GROUND_EVERY]).astype(np.uint8)),
            "corner": corner.tolist(),
            "side": side,
        },
    }


def _shared_faces(faces: Integers, vertex_count: int, triangles: dict[str, dict[str, str]]) -> str:
    """Keep triangles once, and return the key they are found under."""
    kind, code = ("uint16", "<u2") if vertex_count <= _LEVELS else ("uint32", "<u4")
    indices = faces.astype(code)
    key = hashlib.sha256(indices.tobytes()).hexdigest()[:16] + kind
    triangles.setdefault(key, {"kind": kind, "indices": _base64(indices)})
    return key


def _shared_look(look: Look | None, mesh: Mesh, looks: dict[str, dict[str, Any]]) -> str | None:
    """Keep a look once for all meshes that share it, and return the key it is found under."""
    if look is None:
        return None
    of, faces, uvs = look.split(mesh.faces)
    order = np.argsort(look.paint_of, kind="stable")
    counts = np.bincount(look.paint_of, minlength=len(look.paints))
    colors = None if look.colors is None else np.rint(255 * look.colors).astype(np.uint8)
    found = {
        "of": _base64(of.astype("<u4")),
        "faces": _base64(faces[order].astype("<u4")),
        "uvs": _base64(uvs.astype("<f4")),
        "colors": None if colors is None else _base64(colors[of]),
        "paints": [
            {"color": paint.color, "faces": count, "texture": _jpeg(paint.texture)}
            for paint, count in zip(look.paints, counts.tolist(), strict=True)
        ],
    }
    key = hashlib.sha256(json.dumps(found).encode()).hexdigest()[:16]
    looks.setdefault(key, found)
    return key


def _jpeg(texture: npt.NDArray[np.uint8] | None) -> str | None:
    if texture is None:
        return None
    file = io.BytesIO()
    Pillow.fromarray(texture).save(file, "JPEG", quality=_JPEG)
    return f"data:image/jpeg;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


def _view(meshes: dict[str, Mesh]) -> dict[str, Any]:
    """Return an example's first view, that of the pictures: its direction, and the extent to hold."""
    axes, low, high = in_view(meshes)
    extent = high - low
    return {
        "direction": axes[2].tolist(),
        "center": ((low + high) / 2 @ axes).tolist(),
        "width": float(extent[0]),
        "height": float(extent[1]),
        "depth": float(extent[2]),
    }


def _base64(array: npt.NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _printable(value: Any) -> Any:
    """Return a payload whose texts, names among the keys too, can be shown."""
    if isinstance(value, dict):
        return {printable(key): _printable(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_printable(item) for item in value]
    return printable(value) if isinstance(value, str) else value


def _inert_json(payload: Any) -> str:
    """Return JSON that cannot end the script element it stands in, nor open a comment there."""
    text = json.dumps(payload, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@cache
def _asset(name: str) -> str:
    return (files("training.viz") / "assets" / name).read_text(encoding="utf-8")
