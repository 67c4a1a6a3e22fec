"""Cloth draped over a moving body: extended position-based dynamics in small steps, in Warp's kernels on the CPU.

Macklin et al. 2016 (XPBD) and 2019 (small steps in place of iterations; edges get four a step). Edges have no
compliance, bends one that undoes a share a step; so only ratios of masses matter. Every pose starts at the T-pose and
follows a fixed path, so that a garment in a pose is a function of identity and pose alone.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse
import scipy.spatial
from numpy.typing import NDArray

from datagen.bodies.clothed.garments import Garment
from datagen.bodies.clothed.kernels import Pins, Skin, Springs, State, advect, hang, take_steps, touch, touch_part
from datagen.bodies.skinning import Rest
from datagen.common.errors import BodyError
from datagen.common.quiet_warp import wp
from datagen.mesh.geometry import edges_of
from datagen.recipe import DrapeSolver

_REACH, _FAR = 0.1, 1.0  # metres within which the body is looked for: at each station, and once
_FALL, _FALL_LAST = 5.0, 2.5
"""Metres a second squared at the stations, and at the end of settling.

Not 9.81, as few steps do not carry the weight of fine cloth: it would hang stretched. Against so little, bending counts
for more than it would: ``stiffness`` says how folds look, and is no material's constant.
"""
_REACH_PARTS = 0.03  # metres within which the parts below are looked for
_TOGETHER = 10  # steps of settling between two searches for contacts
_DEEP, _MOST_DEEP = 0.01, 0.05  # metres inside of the body at rest, and the share of vertices that may be
_TOUCHING = 0.001  # metres inside of it from which a vertex has less ease
_NEAR, _KIN = 60, 0.02  # triangles that a pin chooses from; the product of weights from which a bone moves both
_GRID = 2.0**20


@dataclass(frozen=True)
class Path:
    """The way of a body from the T-pose, where hands are far from any skirt, to a pose.

    Attributes
    ----------
    body
        Vertices [station, body vertex, 3] float32.
    transforms
        Of the bones [station, bone, 3, 4], from rest.
    cloth
        Vertices [vertex, 3] float32 of the garment at the first station.
    """

    body: NDArray[np.float32]
    transforms: NDArray[np.float64]
    cloth: NDArray[np.float32]


class Cloth:
    """A garment ready to be draped over a body whose faces are ``faces`` [face, 3]."""

    def __init__(self, garment: Garment, worn_by: Rest, faces: NDArray[np.int64]) -> None:
        body, vertices = worn_by.vertices.astype(np.float32), garment.rest.vertices
        self._edges, self._bends = _springs(garment)
        self._mesh = wp.Mesh(points=_vectors(body), indices=_integers(faces.ravel()))
        self._pins = _pins(garment, worn_by, faces)
        self._skin = _skin_of(garment)
        state = State()
        for name in ("place", "before", "velocity", "contact", "normal", "under", "under_normal"):
            setattr(state, name, _vectors(np.zeros_like(vertices)))
        state.inverse_mass = _numbers(_inverse_masses(garment))
        state.distance = _numbers(garment.distance)
        state.tether, state.pin = _tethers(garment)
        self._state = state
        starts = np.searchsorted(garment.part, np.arange(1, garment.part[-1] + 2)).tolist()
        below = [garment.faces[garment.part[garment.faces[:, 0]] < number] for number in range(2, len(starts))]
        state.place.assign(vertices.astype(np.float32))
        self._parts = [
            (first, end - first, wp.Mesh(points=state.place, indices=_integers(faces.ravel())))
            for first, end, faces in zip(starts[1:], starts[2:], below, strict=False)
        ]

    def drape(self, path: Path, solver: DrapeSolver) -> NDArray[np.float32]:
        """Vertices [vertex, 3] at the end of a path, rounded to 2^-20 metres."""
        state = self._state
        state.place.assign(path.cloth)
        state.velocity.zero_()
        turns = [_of(wp.mat33, transforms[:, :, :3]) for transforms in path.transforms]
        shifts = [_vectors(transforms[:, :, 3]) for transforms in path.transforms]
        for station, body in enumerate(path.body):
            self._mesh.points.assign(body)
            self._mesh.refit()
            if station:
                ways = turns[station - 1], shifts[station - 1], turns[station], shifts[station]
                _launch(advect, len(state.place), self._skin, *ways, state)
                _launch(hang, len(self._pins.vertex), self._pins, self._mesh.points, state)
            self._relax(solver.substeps, _FALL)
        for begun in range(0, solver.settle, _TOGETHER):
            fall = max(_FALL_LAST, _FALL * (1 - begun / solver.settle))
            self._relax(min(_TOGETHER, solver.settle - begun), fall)
        found: NDArray[np.float32] = np.round(state.place.numpy().astype(np.float64) * _GRID) / _GRID
        return found.astype(np.float32)

    def _relax(self, steps: int, gravity: float) -> None:
        state = self._state
        _launch(touch, len(state.place), self._mesh.id, _REACH, state)
        for first, count, below in self._parts:
            below.refit()
            _launch(touch_part, count, below.id, first, _REACH_PARTS, state)
        _launch(take_steps, 1, steps, gravity, self._edges, self._bends, state)


def depths(vertices: NDArray[np.float32], body: NDArray[np.float32], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """How deep each vertex [vertex] lies within a body, in metres; negative outside, -1 far from it."""
    mesh, state = wp.Mesh(points=_vectors(body), indices=_integers(faces.ravel())), State()
    state.place, state.contact, state.normal = (_vectors(its) for its in (vertices, 0 * vertices, 0 * vertices))
    _launch(touch, len(vertices), mesh.id, _FAR, state)
    away = (state.place.numpy() - state.contact.numpy()).astype(np.float64)
    normal = state.normal.numpy().astype(np.float64)
    found: NDArray[np.float64] = np.where((normal**2).sum(axis=1) > 0.5, -(away * normal).sum(axis=1), -_FAR)
    return found


def require_outside(garment: Garment, body: Rest, faces: NDArray[np.int64], *, name: str) -> None:
    """Refuse a garment (BodyError, which gives it this name) too much of which is inside of the body at rest."""
    cloth, skin = garment.rest.vertices.astype(np.float32), body.vertices.astype(np.float32)
    share = float(np.mean(depths(cloth, skin, faces) > _DEEP))
    if share > _MOST_DEEP:
        raise BodyError(
            f"{share:.0%} of the vertices of {name} are more than {1000 * _DEEP:.0f} mm inside of the body at rest, "
            f"where {_MOST_DEEP:.0%} can be pushed out. Give its parts under data.body.own a larger ease or flare"
        )


def outside(garment: Garment, body: Rest, faces: NDArray[np.int64]) -> Garment:
    """The garment at rest with less ease where that had put it into the body: a wide sleeve into the ribs beside it."""
    eased, near = garment.rest.vertices, garment.uneased
    places = eased
    for share in (0.75, 0.5, 0.25, 0.0):
        deep = depths(places.astype(np.float32), body.vertices.astype(np.float32), faces) > _TOUCHING
        places = np.where(deep[:, None], np.round((near + share * (eased - near)) * _GRID) / _GRID, places)
    return replace(garment, rest=replace(garment.rest, vertices=places))


def _springs(garment: Garment) -> tuple[Any, Any]:
    """Edges, which keep their length, and pairs of vertices across an edge, which resist bending.

    A step undoes a share of what such a pair is too near or too far, whatever the vertices weigh: small triangles,
    which are light, would be rigid by a compliance that large ones bend by.
    """
    faces = garment.faces
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    opposite = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])
    edges, numbers, counts = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    across = opposite[np.argsort(numbers.ravel(), kind="stable")]
    starts = np.cumsum(counts) - counts
    inner = starts[counts == 2]
    pairs = np.stack([across[inner], across[inner + 1]], axis=1)
    compliance = _inverse_masses(garment)[pairs].sum(axis=1) * (1 / garment.bending[pairs[:, 0]] - 1)
    return _springs_of(garment, edges, np.zeros(len(edges))), _springs_of(garment, pairs, compliance)


def _tethers(garment: Garment) -> tuple[Any, Any]:
    """How far each vertex can be from the nearest pin along edges of cloth, in metres, and which that is.

    Long range attachments (Kim et al. 2012): without them small steps leave fine cloth stretched by its weight.
    """
    edges, count = edges_of(garment.faces), len(garment.rest.vertices)
    if not garment.pinned.any():
        return _numbers(np.full(count, np.inf)), _integers(np.zeros(count))
    graph = scipy.sparse.csr_array((garment.lengths(edges), tuple(edges.T)), shape=(count, count))
    far, _, pins = scipy.sparse.csgraph.dijkstra(
        graph, directed=False, indices=np.flatnonzero(garment.pinned), return_predecessors=True, min_only=True
    )
    return _numbers(far), _integers(np.maximum(pins, 0))


def _springs_of(garment: Garment, pairs: NDArray[np.int64], compliance: NDArray[np.float64]) -> Any:
    springs = Springs()
    springs.ends, springs.compliance = _of(wp.vec2i, pairs), _numbers(compliance)
    springs.length = _numbers(garment.lengths(pairs))
    return springs


def _skin_of(garment: Garment) -> Any:
    weights, skin = scipy.sparse.csr_array(garment.rest.weights), Skin()
    weights.sort_indices()
    skin.rest = _vectors(garment.rest.vertices)
    skin.first, skin.bone = _integers(weights.indptr), _integers(weights.indices)
    skin.weight = _numbers(weights.data)
    return skin


def _pins(garment: Garment, body: Rest, faces: NDArray[np.int64]) -> Any:
    """Hang each pinned vertex, where it is at rest, on a triangle near it (:func:`_nearest_kin`)."""
    pins, vertices = Pins(), np.flatnonzero(garment.pinned)
    places, corners = garment.rest.vertices[vertices], body.vertices[faces]
    nearest = _nearest_kin(garment.rest, vertices, body, faces)
    a, b, c = corners[nearest].transpose(1, 0, 2)
    across = np.cross(b - a, c - a)
    area = (across**2).sum(axis=1)
    second = (np.cross(places - a, c - a) * across).sum(axis=1) / area
    third = (np.cross(b - a, places - a) * across).sum(axis=1) / area
    pins.vertex, pins.corners = _integers(vertices), _of(wp.vec3i, faces[nearest])
    pins.barycentric = _vectors(np.stack([1 - second - third, second, third], axis=1))
    pins.above = _numbers(((places - a) * across).sum(axis=1) / np.sqrt(area))
    return pins


def _nearest_kin(rest: Rest, vertices: NDArray[np.int64], body: Rest, faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """The triangle [vertex] with the nearest middle of those that one of its bones moves: no hand by a waist."""
    distances, near = scipy.spatial.cKDTree(body.vertices[faces].mean(axis=1)).query(rest.vertices[vertices], _NEAR)
    mine, theirs = scipy.sparse.csr_array(rest.weights)[vertices], scipy.sparse.csr_array(body.weights)
    kin = [mine.multiply(theirs[faces[triangles, 0]]).sum(axis=1) > _KIN for triangles in near.T]
    best = np.where(np.stack(kin, axis=1), distances, distances + _FAR).argmin(axis=1)
    return np.asarray(np.take_along_axis(near, best[:, None], axis=1)[:, 0], np.int64)


def _inverse_masses(garment: Garment) -> NDArray[np.float64]:
    """One over the mass of each vertex [vertex], a third of the area around it (m^2); 0 of those that are pinned."""
    vertices, faces = garment.rest.vertices, garment.faces
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    area = np.sqrt((np.cross(second - first, third - first) ** 2).sum(axis=1)) / 2
    mass = np.bincount(faces.ravel(), np.repeat(area / 3, 3), len(vertices))
    return np.where(garment.pinned, 0.0, 1 / mass)


def _launch(kernel: Any, size: int, *inputs: Any) -> None:
    wp.launch(kernel, dim=size, inputs=list(inputs), device="cpu")


def _of(kind: Any, values: NDArray[Any]) -> Any:
    return wp.array(np.ascontiguousarray(values, np.int32 if kind in (wp.vec2i, wp.vec3i) else np.float32), dtype=kind,
                    device="cpu")  # fmt: skip


def _vectors(values: NDArray[Any]) -> Any:
    return _of(wp.vec3, values)


def _numbers(values: NDArray[Any]) -> Any:
    return wp.array(values.astype(np.float32), dtype=wp.float32, device="cpu")


def _integers(values: NDArray[Any]) -> Any:
    return wp.array(values.astype(np.int32), dtype=wp.int32, device="cpu")
