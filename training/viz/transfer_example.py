"""One transfer by one method or several: what the figures and the viewer draw."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, standing_point
from training.viz.look import Look
from training.viz.render.camera import Camera, azimuth_of, frame

PANEL = (480, 560)
"""Pixels of a panel of a picture of one transfer without a known truth."""

_REACH = 0.2  # of the right shape's box: what an output may reach beyond it and still be framed


@dataclass(frozen=True)
class Comparison:
    """One transfer; all meshes Y up, facing +Z, in one unit.

    Parameters
    ----------
    title : str
        Caption, for example ``"unseen pose 231, to identity 19"``.
    source, target : mesh
        Who gives the pose, and who gives the identity.
    outputs : dict
        Name of each method -> its mesh, with the vertices of the target in the same order.
    truth : mesh or None
        The right mesh, vertex by vertex, where it is known.
    metrics : dict
        Name of a method -> few words to stand under its picture, for example ``"PMD 12.3e-4"``.
    motion : Motion, optional
        Frames that begin with this transfer, for the viewer; of one method.
    """

    title: str
    source: Mesh
    target: Mesh
    outputs: Mapping[str, Mesh]
    truth: Mesh | None = None
    metrics: Mapping[str, str] = field(default_factory=dict)
    motion: "Motion | None" = None

    def meshes(self) -> dict[str, Mesh]:
        """All meshes by name: ``source``, ``target``, ``output NAME`` for each method, ``truth`` if there is one."""
        given = {"source": self.source, "target": self.target}
        outputs = {output_of(name): mesh for name, mesh in self.outputs.items()}
        return {**given, **outputs, **({} if self.truth is None else {"truth": self.truth})}


@dataclass(frozen=True)
class Motion:
    """A sequence: source and output of each frame, in the units and axes of the first, and frames a second."""

    frames: Sequence[tuple[Mesh, Mesh]]
    rate: float


@dataclass(frozen=True)
class NamedMesh(Mesh):
    """A mesh, Y up and facing +Z, what the page calls it, and what its faces look like in its file."""

    name: str
    look: Look | None = None


def shown(
    source: NamedMesh, target: NamedMesh, output: NamedMesh, *, motion: Motion | None = None, title: str = ""
) -> Comparison:
    """One transfer without a known truth, as figures and viewer take it; ``motion``: the frames that it begins."""
    title = title or f"{target.name} in the pose of {source.name}"
    return Comparison(title=title, source=source, target=target, outputs={"Output": output}, motion=motion)


ERROR_UNIT = "cm"


def output_of(method: str) -> str:
    """Return the name of a method's mesh in :meth:`Comparison.meshes`."""
    return f"output {method}"


def methods_in(comparisons: Sequence[Comparison]) -> list[str]:
    """Return the names of all methods, in the order in which they first come."""
    return list(dict.fromkeys(name for one in comparisons for name in one.outputs))


def errors_of(comparison: Comparison) -> dict[str, Floats]:
    """Return each method's errors [v] in centimetres, of vertices in metres; empty without a truth."""
    return {name: 100 * errors for name, errors in vertex_errors(comparison).items()}


def error_limit(comparisons: Sequence[Comparison]) -> float:
    """Return where the colours of errors end, in centimetres: the 99th percentile of a method's errors in all rows.

    Of several methods it is the median of their percentiles: one bad method does not make all others look alike.
    """
    pooled: dict[str, list[Floats]] = {}
    for comparison in comparisons:
        for name, errors in errors_of(comparison).items():
            pooled.setdefault(name, []).append(errors)
    tops = [float(np.percentile(np.concatenate(errors), 99)) for errors in pooled.values()]
    return max(float(np.median(tops)), 1e-12) if tops else 1.0


def vertex_errors(comparison: Comparison) -> dict[str, Floats]:
    """Return each method's Euclidean distances [v], in their unit, of output vertices to the same of the truth.

    Raises
    ------
    ValueError
        If an output has not as many vertices as the truth.
    """
    if comparison.truth is None:
        return {}
    truth = np.asarray(comparison.truth.vertices, float)
    found = {}
    for name, mesh in comparison.outputs.items():
        output = np.asarray(mesh.vertices, float)
        if output.shape != truth.shape:
            raise ValueError(
                f"{comparison.title}: output {output.shape} of {name} and truth {truth.shape} differ in shape"
            )
        found[name] = np.linalg.norm(output - truth, axis=1)
    return found


def best_of(errors: Mapping[str, Floats]) -> str | None:
    """Return the method with the least mean squared error, which is that with the least PMD; None for fewer than two.

    PMD is this mean, in the truth's box and over three coordinates: one factor for all methods.
    """
    return min(errors, key=lambda name: float(np.square(errors[name]).mean())) if len(errors) > 1 else None


def placed(comparison: Comparison) -> dict[str, Mesh]:
    """Return all meshes, named as in :meth:`Comparison.meshes`, set down on the ground at the origin.

    Outputs are moved together with the truth, so that an offset between them is seen. The source only shows a pose:
    it is drawn at the size (longest edge of the box) of the truth or, without one, of the first output.

    Raises
    ------
    ValueError
        If a vertex is not finite.
    """
    meshes = {name: Mesh(np.asarray(m.vertices, float), np.asarray(m.faces)) for name, m in comparison.meshes().items()}
    for name, mesh in meshes.items():
        if bad := int((~np.isfinite(mesh.vertices).all(1)).sum()):
            raise ValueError(f"{comparison.title}: {bad} of {len(mesh.vertices)} vertices of the {name} are not finite")
    right = meshes.get("truth") or next((m for name, m in meshes.items() if name.startswith("output ")), None)
    return {
        name: Mesh(_stood(mesh, name, right, moves_with=meshes.get("truth")), mesh.faces)
        for name, mesh in meshes.items()
    }


def placed_frames(comparison: Comparison) -> Iterator[tuple[Mesh, Mesh]]:
    """Yield source and output of each frame, moved and scaled as :func:`placed` does with those of the first."""
    if comparison.motion is None:
        return
    (output,) = comparison.outputs.values()
    scale = _size(output.vertices) / max(_size(comparison.source.vertices), 1e-12)
    starts = standing_point(comparison.source.vertices), standing_point(output.vertices)
    for source, posed in comparison.motion.frames:
        moved = scale * (source.vertices - starts[0]), posed.vertices - starts[1]
        yield Mesh(moved[0], source.faces), Mesh(moved[1], posed.faces)


def look_at(mesh: Mesh) -> Look | None:
    """Return what the faces of a mesh look like by themselves, where it says so."""
    return mesh.look if isinstance(mesh, NamedMesh) else None


def _stood(mesh: Mesh, name: str, right: Mesh | None, *, moves_with: Mesh | None) -> Floats:
    anchor = moves_with if moves_with is not None and name.startswith("output ") else mesh
    scale = 1.0
    if name == "source" and right is not None:
        scale = _size(right.vertices) / max(_size(mesh.vertices), 1e-12)
    return scale * (mesh.vertices - standing_point(anchor.vertices))


def _size(vertices: Floats) -> float:
    return float(np.ptp(vertices, axis=0).max())


def camera_of(meshes: Mapping[str, Mesh], size: tuple[int, int] = (320, 400)) -> Camera:
    """Return the camera that holds the placed meshes of a comparison in a panel of `size` pixels.

    The side it looks from suits source, target and truth, whatever the outputs look like.
    """
    known = [mesh for name, mesh in meshes.items() if not name.startswith("output ")]
    return frame(_to_hold(meshes), size=size, azimuth=azimuth_of(known), margin=0.055)


def in_view(meshes: Mapping[str, Mesh]) -> tuple[Floats, Floats, Floats]:
    """Return the axes [3, 3] of that camera as rows, and the least and largest coordinates [3] along them."""
    axes = camera_of(meshes).axes()
    points = np.concatenate([mesh.vertices for mesh in _to_hold(meshes)]) @ axes.T
    return axes, points.min(0), points.max(0)


def _to_hold(meshes: Mapping[str, Mesh]) -> list[Mesh]:
    """Return what a picture must hold: an output that strays far from the truth does not shrink all the others."""
    known = [mesh for name, mesh in meshes.items() if not name.startswith("output ")]
    if "truth" not in meshes:
        return list(meshes.values())
    points = np.concatenate([mesh.vertices for mesh in known])
    low, high = points.min(0), points.max(0)
    reach = _REACH * (high - low)
    outputs = [mesh for name, mesh in meshes.items() if name.startswith("output ")]
    return known + [Mesh(np.clip(mesh.vertices, low - reach, high + reach), mesh.faces) for mesh in outputs]
