"""An interactive page of transfer examples: one HTML file that needs neither network nor server.

What is embedded, little-endian in base64: positions as uint16 between the corners of each mesh's box (off by at most
half a step, ``box / 65535 / 2``: 15 micrometres for a body of 2 m), triangles as uint16 or uint32 and once for all
meshes that share them, errors as float32 in the unit of the colour bar. The drawing code is assets/viewer.js, bundled
with three.js.
"""

import base64
import hashlib
import html
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

from datagen.mesh import write_atomically
from training.figures import (
    ERROR_COLORS,
    ROLE_COLORS,
    ErrorScale,
    TransferExample,
    placed,
    vertex_errors,
)
from training.rasteriser import Floats, Integers
from training.rendering import frame, ground_shadow, openness

_LEVELS = 65535
_GROUND_EVERY = 2  # the page keeps every second cell of the ground's shadow


def write_viewer(
    examples: Sequence[TransferExample],
    path: str | os.PathLike[str],
    *,
    title: str,
    error_scale: ErrorScale | None = None,
) -> Path:
    """Write a page with source, target, output, ground truth and error of every example, to be turned with the mouse.

    It works from a file, from a server, and inside a frame; it loads nothing. Names and titles are shown as plain text.

    Parameters
    ----------
    examples : sequence of TransferExample
        A mesh's ``name`` attribute, where it has one, is shown under its panel.
    path : path of the HTML to write
    title : str
        Heading of the page.
    error_scale : ErrorScale, optional
        Unit of the errors; by default centimetres for vertices in metres.

    Returns
    -------
    Path
        The path of the page.

    Raises
    ------
    ValueError
        If there is no example, or an output and its truth differ in shape.
    """
    if not examples:
        raise ValueError("write_viewer needs at least one example")
    payload = viewer_payload(examples, error_scale=error_scale or ErrorScale())
    licence = f"/*\n{_asset('THREE-LICENSE.txt')}*/\n"  # a page is a copy of three.js, so its licence goes along
    page = Template(_asset("viewer.html")).substitute(
        title=html.escape(title),
        style=_asset("viewer.css"),
        data=_inert_json(payload),
        bundle=licence + _asset("viewer.bundle.js"),
    )
    write_atomically(Path(path), page.encode())
    return Path(path)


def viewer_payload(examples: Sequence[TransferExample], *, error_scale: ErrorScale) -> dict[str, Any]:
    """Return what the page is given: meshes standing on the ground, errors, colours and the first view."""
    triangles: dict[str, dict[str, str]] = {}
    return {
        "examples": [_example(example, error_scale, triangles) for example in examples],
        "faces": triangles,
        "colors": dict(ROLE_COLORS),
        "error": {
            "unit": error_scale.unit,
            "limit": error_scale.resolved(examples),
            "colors": np.rint(255 * ERROR_COLORS).astype(int).tolist(),
        },
        "view": _view(examples),
    }


def decode_positions(mesh: dict[str, Any]) -> Floats:
    """Return the positions [v, 3] of an embedded mesh, as the page sees them."""
    levels = np.frombuffer(base64.b64decode(mesh["positions"]), "<u2").reshape(-1, 3)
    return np.asarray(np.array(mesh["low"]) + levels * np.array(mesh["step"]))


def _example(example: TransferExample, scale: ErrorScale, triangles: dict[str, dict[str, str]]) -> dict[str, Any]:
    errors = scale.factor * vertex_errors(example)
    return {
        "title": example.title,
        "metrics": example.metrics,
        "meshes": {
            role: _mesh(vertices, getattr(example, role), triangles) for role, vertices in placed(example).items()
        },
        "errors": _base64(errors.astype("<f4")),
        "error_text": f"mean {errors.mean():.3g}, largest {errors.max():.3g} {scale.unit}",
    }


def _mesh(vertices: Floats, original: Any, triangles: dict[str, dict[str, str]]) -> dict[str, Any]:
    low = vertices.min(0)
    step = np.maximum(np.ptp(vertices, axis=0), 1e-12) / _LEVELS
    faces = np.asarray(original.faces, np.int64)
    shadow, corner, side = ground_shadow(vertices, faces)
    return {
        "name": str(getattr(original, "name", "")),
        "positions": _base64(np.rint((vertices - low) / step).astype("<u2")),
        "low": low.tolist(),
        "step": step.tolist(),
        "faces": _shared_faces(faces, len(vertices), triangles),
        "openness": _base64(np.rint(255 * np.clip(openness(vertices, faces), 0, 1)).astype(np.uint8)),
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


def _view(examples: Sequence[TransferExample]) -> dict[str, Any]:
    """Return the first view, one scale for all examples: the direction of the pictures, and the extent to hold."""
    points = np.concatenate([vertices for example in examples for vertices in placed(example).values()])
    axes = frame([_Points(points)]).axes()
    in_view = points @ axes.T
    extent = np.ptp(in_view, axis=0)
    return {
        "direction": axes[2].tolist(),
        "center": ((in_view.min(0) + in_view.max(0)) / 2 @ axes).tolist(),
        "width": float(extent[0]),
        "height": float(extent[1]),
        "depth": float(extent[2]),
    }


class _Points:
    def __init__(self, vertices: Floats) -> None:
        self.vertices: Floats = vertices
        self.faces: Integers = np.zeros((0, 3), np.int64)


def _base64(array: npt.NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _inert_json(payload: dict[str, Any]) -> str:
    """Return JSON that cannot end the script element it stands in, nor open a comment there."""
    text = json.dumps(payload, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@cache
def _asset(name: str) -> str:
    return (files("training") / "assets" / name).read_text(encoding="utf-8")
