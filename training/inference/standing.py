"""How a body stands, found by a network that says how well it understands one (`Parts.understood`).

Whether it is such a body at all, another question, is asked of it once it stands (`Parts.rest_error`).

Unlike :mod:`training.inference.orientation`, which asks of any network whether a mesh comes back from it, this finds
turns between the axes as well, so that it is done without being asked for.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, bounding_box
from training.inference.mesh_reading import surface_of_meshes
from training.networks.layers.sampling import Sample, sample
from training.networks.parts import Parts

Understanding = Callable[[Floats], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Meshes [b, n, 3] in the normalised box -> how badly [b] each is understood (misfit), and how its root is turned from
rest [b, 3, 3]."""


def understanding_of(network: Parts) -> Understanding:
    """Return what a network understands of meshes, a few at a time, where it is."""
    device = next(network.parameters()).device

    def understand(meshes: Floats) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        parts = torch.split(torch.from_numpy(np.ascontiguousarray(meshes, np.float32)), _MESHES_AT_ONCE)
        found = [network.understood(part.to(device)) for part in parts]
        misfits, roots = (torch.cat(each).double().cpu().numpy() for each in zip(*found, strict=True))
        return misfits, roots

    return understand


MISREAD = 7.0
"""Degrees of rest error above which a mesh is misread, or no body that the network knows: nearly all people, bare or
dressed, and animals that were read rightly by weights of their kind have less, things have more
(docs/results/transfer.md)."""
SURELY_READ = 3.5
"""Degrees of rest error up to which an upright mesh that faces ahead is read rightly: turned by a quarter or a half,
and read so all the same, people have more by `human`, animals by `animals` (docs/results/parts-experiments.md)."""
KNOWN = 0.002
"""Misfit up to which a mesh is well understood as it stands, as most bare people in NPT's poses are
(docs/results/transfer.md)."""
_STRAIGHT = np.radians(9.0)  # a facing that may be an error of the network's own; twice that of a leaning mesh
_UPRIGHT = np.radians(12.0)  # a root leans so far for a pose, or for an error of the network's own
_LEANS = np.radians(50.0)  # from Y, which is up in most files: a little more than half way to another axis
_CLEARLY = 1.5  # times less is the misfit of another way to stand, where it is taken
_SURELY = 6.0  # times less than that of another way by a few vertices, which leave more: no need to read it by others
_NEARLY = 1.25  # times the rest error of another way: as well read, or no worse
_SETTLED = np.radians(1.0)  # a turn that is not worth another reading
_MESHES_AT_ONCE = 16
_LOOKED_AT, _VERTICES = 4096, 256  # of a mesh: to know its box, and to read
_MORE_VERTICES = 512  # read of a mesh that is not understood as it is by fewer
_FIRST_VERTICES, _KEPT = 64, 24  # read to rank many ways or to rule out some, and how many ranked are read well then
_DRAWN = 1024  # of the vertices that are looked at, from which those that are read are drawn by area
_AROUND, _FAR = 9, 3.0  # itself and eight others, whose distance tells the area; times the median of it at most
_SIDES = 6  # of a box: directions along the axes
_QUARTER_TURNS = [turn.as_matrix() for turn in Rotation.create_group("O") if turn.magnitude() > 0.1]  # about all axes
_KEPT_TURNS = 6  # of these, read with the surface
_TURNS = 3
_TILTS = np.radians([16.0, 8.0, 4.0])  # about any axis, tried after the best of all ways is known
_ANGLES = np.radians(np.arange(0.0, 360.0, 30.0))


@dataclass(frozen=True, eq=False)
class Standing:
    """A turn from a mesh' own axes to those of training (Y up, facing +Z), and what misfit is left then.

    Attributes
    ----------
    matrix
        [3, 3].
    misfit
        In the normalised box, without the lean.
    rest_error
        In degrees (`Parts.rest_error`); NaN where it was not asked for.
    lean
        How the body is turned [3, 3] from upright after that, where it has to be known before the body is understood.
    root
        How the root is turned from rest [3, 3] then; None where nobody asked.
    """

    matrix: NDArray[np.float64]
    misfit: float
    rest_error: float = np.nan
    lean: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    root: NDArray[np.float64] | None = None

    @property
    def leans(self) -> bool:
        """Whether there is a lean."""
        return not np.array_equal(self.lean, np.eye(3))

    def turned(self, vertices: Floats) -> Floats:
        """Vertices [..., 3] in the mesh' own axes -> Y up, facing +Z."""
        return vertices @ self.matrix.T

    def upright(self, vertices: Floats) -> Floats:
        """Vertices [..., 3] in the mesh' own axes -> Y up, facing +Z, without the lean."""
        return self.turned(vertices) @ self.lean

    def restored(self, vertices: Floats) -> Floats:
        """Vertices [..., 3], Y up and facing +Z -> the mesh' own axes."""
        return vertices @ self.matrix


def standing(understand: Understanding, mesh: Floats) -> Standing:
    """Find how a mesh stands.

    A mesh that is understood as it is stays so, but for a clear turn about the vertical. Of one that is not, twelve
    angles about the vertical are tried, which do where one is understood twice as well as it must be; then 26
    directions as its way upward, each at twelve angles, which a few vertices rank before the first of them are read as
    well as the others; and small turns of the best. Another way is taken where it is clearly better understood. A body
    whose way upward is at most 50 degrees from the file's Y then leans; as that may be the pose, it is said, not
    undone. Else a way between the mesh' axes is taken where it is clearly better than all along them: nothing but the
    body says which way is up then, so its root is brought to rest. A lean that is understood is left, too (`facing`).

    Parameters
    ----------
    mesh
        Vertices [n, 3] in any unit; 256 of them are read, 64 to rank many ways, and to rule out turns aside of a mesh
        that is understood as it is. As it is, a mesh that is not understood by 256 is read by 512: they leave less
        misfit, so that it stays so where that is in doubt.
    """
    ways = _Ways(understand, _probe(mesh))
    return _found(ways, ways.as_it_is())


def _found(ways: "_Ways", as_it_is: "_Seen") -> Standing:
    """How a mesh stands that is seen so as it is (`standing`)."""
    at_first = ways
    if as_it_is.misfit > KNOWN and (more := ways.by_more()):
        at_first, as_it_is = more, more.as_it_is()
    if as_it_is.misfit <= KNOWN and at_first.none_is_clearer(as_it_is):
        return at_first.faced(as_it_is).stands if as_it_is.is_aside else as_it_is.stands
    best = min(ways.seen([_about_vertical(angle) for angle in _ANGLES]), key=lambda way: way.misfit)
    understood = best.misfit <= KNOWN and _CLEARLY * best.misfit < as_it_is.misfit
    ahead = ways.ahead(best) if understood else None
    if ahead and ahead.misfit <= KNOWN / 2:
        return ahead.stands
    every = ways.seen([_about_vertical(angle) @ up for up in _upward() for angle in _ANGLES], _FIRST_VERTICES)
    along_axes, best = (ways.best_of(some) for some in (every[: _SIDES * len(_ANGLES)], every))
    best = min(along_axes, best, key=lambda way: way.misfit)
    for size in _TILTS:
        tilted = [_turn(axis, angle) @ best.way for axis in np.eye(3) for angle in (-size, size)]
        best = min(ways.seen([best.way, *tilted]), key=lambda way: way.misfit)
    found, upright = ways.faced(along_axes), ways.turned(best, lambda found: found.root.T)
    likely = _CLEARLY * upright.misfit < as_it_is.misfit and upright.misfit <= _CLEARLY * found.misfit
    leans = likely and _leaning(upright.way.T) <= _LEANS
    if leans:
        found = upright
    elif along_axes.misfit > _CLEARLY * best.misfit:
        found = min(found, upright, key=lambda way: way.misfit)
    if ahead and ahead.misfit <= min(KNOWN, _CLEARLY * found.misfit):
        return ahead.stands
    if leans:
        return upright.leans
    return found.stands if _CLEARLY * found.misfit < as_it_is.misfit else as_it_is.stands


def stands(network: Parts, mesh: Mesh) -> Standing:
    """Find how a mesh stands (`standing`), told its surface where vertices alone leave a doubt.

    Where parts touch, as a hand does a hip, vertices alone are misunderstood, and facing is read off them less well. So
    one that is not well understood as it is, or not clearly better than from behind, or faces aside, is read with its
    surface; where it stands upright, faces ahead and has a rest error of at most `SURELY_READ` then, it stays so,
    unasked for other ways. Of a mesh for which another way was found, the facing is corrected; but one that is read to
    face straight ahead as it is, with a rest error of at most 1.25 times the other way's, stays so. One that is misread
    even then, and was not found to lean, is turned by quarters about all axes, where that makes the rest error clearly
    less.
    """
    body = _Body(network, mesh)
    seen = body.ways.as_it_is()
    in_doubt = seen.misfit > KNOWN or seen.is_aside or body.ways.behind.misfit < _CLEARLY * seen.misfit
    stays = body.read(seen.way, seen.misfit) if in_doubt else seen.stands
    assert stays.root is not None
    if stays.rest_error <= SURELY_READ and _is_straight(stays.root) and _leaning(stays.root) <= _UPRIGHT:
        return stays
    found = _found(body.ways, seen)
    if found.leans or not np.array_equal(found.matrix, stays.matrix):
        found = body.rather(found, stays)
    elif in_doubt:
        found = replace(found, rest_error=stays.rest_error, root=stays.root)
    if found.leans or not found.rest_error > MISREAD:
        return found
    if clearer := body.clearer_turn(found):
        return clearer
    return replace(found, rest_error=rest_error(network, Mesh(found.turned(mesh.vertices), mesh.faces)))


class _Body:
    """A mesh whose surface a network reads, as it is turned."""

    def __init__(self, network: Parts, mesh: Mesh) -> None:
        self._network, self._mesh = network, mesh
        self.ways = _Ways(understanding_of(network), _probe(mesh.vertices))

    def read(self, way: NDArray[np.float64], misfit: float) -> Standing:
        """Turned in this way [3, 3], which leaves such a misfit."""
        error, root = _read(self._network, Mesh(self._mesh.vertices @ way.T, self._mesh.faces))
        return Standing(way, misfit, rest_error=error, root=root)

    def rather(self, found: Standing, stays: Standing) -> Standing:
        """The way found, facing ahead, or that it stays as it is, where its surface is read as well then."""
        error = rest_error(self._network, Mesh(found.upright(self._mesh.vertices), self._mesh.faces))
        if np.isnan(stays.rest_error):
            stays = self.read(stays.matrix, stays.misfit)
        assert stays.root is not None
        if stays.rest_error <= _NEARLY * error and _is_straight(stays.root):
            return stays
        if found.leans:
            return replace(found, rest_error=error)
        return self._faced(self.read(found.matrix, self.ways.seen([found.matrix])[0].misfit))

    def clearer_turn(self, found: Standing) -> Standing | None:
        """The turn by quarters from the way found with clearly less rest error, if there is one."""
        turned = self.ways.seen([turn @ found.matrix for turn in _QUARTER_TURNS])
        likely = sorted(turned, key=lambda turn: turn.misfit)[:_KEPT_TURNS]
        best = min((self.read(turn.way, turn.misfit) for turn in likely), key=lambda turn: turn.rest_error)
        return self._faced(best) if _CLEARLY * best.rest_error < found.rest_error else None

    def _faced(self, found: Standing) -> Standing:
        """Turned about the vertical until its surface is read to face ahead."""
        for _ in range(_TURNS):
            assert found.root is not None
            if _is_straight(found.root):
                break
            ahead = self.ways.seen([_about_vertical(-_facing(found.root)) @ found.matrix])[0]
            read = self.read(ahead.way, ahead.misfit)
            if read.rest_error > _NEARLY * found.rest_error:
                break
            found = read
        return found


def facing(understand: Understanding, vertices: Floats, before: NDArray[np.float64] | Standing) -> NDArray[np.float64]:
    """Return the turn [3, 3] of a body with Y up from upright and facing +Z: ``before`` but for a clear change.

    ``before`` is the turn [3, 3] of the last frame, or how this very body was found to stand. A change is clear about
    the vertical (above 9 degrees), or about any axis where the body leans by more than 12 degrees, seen from
    ``before``, and has a lesser misfit upright.
    """
    probe = _probe(vertices)

    def seen(way: NDArray[np.float64]) -> _Seen:
        misfits, roots = understand(_boxed(probe @ way)[None])
        return _Seen(way, float(misfits[0]), roots[0])

    if isinstance(before, Standing):
        known = None if before.root is None else _Seen(before.lean, before.misfit, before.root)
        found = known or seen(before.lean)
    else:
        found = seen(before)
    for _ in range(_TURNS):
        if _leaning(found.root) <= _UPRIGHT or (upright := seen(found.way @ found.root)).misfit >= found.misfit:
            break
        found = upright
    return found.way @ _about_vertical(found.facing) if abs(found.facing) > _STRAIGHT else found.way


def misfit(understand: Understanding, vertices: Floats) -> float:
    """Return how badly a mesh [n, 3] is understood as it stands."""
    return float(understand(_boxed(_probe(vertices))[None])[0][0])


@torch.no_grad()
def rest_error(network: Parts, mesh: Mesh) -> float:
    """Return by how many degrees a mesh that stands with Y up is misread (`Parts.rest_error`)."""
    upright = mesh.vertices @ facing(understanding_of(network), mesh.vertices, np.eye(3))
    return _read(network, Mesh(upright, mesh.faces))[0]


@torch.no_grad()
def _read(network: Parts, mesh: Mesh) -> tuple[float, NDArray[np.float64]]:
    """The rest error of a mesh as it is, and how its root is turned from rest [3, 3]."""
    drawn = sampled(network, mesh)
    reading = network.read(drawn)
    return float(network.rest_error(reading, drawn)), reading.rotations[0, 0].double().cpu().numpy()


def sampled(network: Parts, mesh: Mesh) -> Sample:
    """Return what a network reads of a mesh, in its box, with what is near along the surface."""
    vertices = bounding_box(mesh.vertices).normalise(mesh.vertices).astype(np.float32)[None]
    device = next(network.parameters()).device
    return sample(torch.from_numpy(vertices).to(device), surface_of_meshes([mesh]).to(device))


class _Seen(NamedTuple):
    """A way to turn a mesh [3, 3], how it is understood then, and how its root is turned from rest [3, 3]."""

    way: NDArray[np.float64]
    misfit: float
    root: NDArray[np.float64]

    @property
    def facing(self) -> float:
        return _facing(self.root)

    @property
    def is_aside(self) -> bool:
        """Whether it clearly faces elsewhere than ahead, which is read less well of a body that leans."""
        return abs(self.facing) > (_STRAIGHT if _leaning(self.root) <= _UPRIGHT else 2 * _STRAIGHT)

    @property
    def stands(self) -> Standing:
        return Standing(self.way, self.misfit, root=self.root)

    @property
    def leans(self) -> Standing:
        """Of a way that brings a body upright: turned about the vertical alone, the rest being its lean."""
        facing = _facing(self.way.T)
        about = _about_vertical(-facing if abs(facing) > _STRAIGHT else 0.0)
        return Standing(about, self.misfit, lean=about @ self.way.T, root=self.root)


class _Ways:
    """Ways to turn the points [n, 3] of a mesh, and what a network understands of it then."""

    def __init__(self, understand: Understanding, points: Floats, vertices: int | None = None) -> None:
        self._understand, self._points, self._vertices = understand, points, vertices or _VERTICES

    def as_it_is(self) -> _Seen:
        return self.seen([np.eye(3)])[0]

    @cached_property
    def behind(self) -> _Seen:
        """From behind."""
        return self.seen([_about_vertical(np.pi)])[0]

    def by_more(self) -> "_Ways | None":
        """The same by more vertices, where the mesh has any."""
        return _Ways(self._understand, self._points, _MORE_VERTICES) if len(self._points) > self._vertices else None

    def seen(self, ways: Sequence[NDArray[np.float64]], vertices: int | None = None) -> list[_Seen]:
        read = vertices or self._vertices
        misfits, roots = self._understand(np.stack([_boxed(self._points @ way.T, read) for way in ways]))
        return [_Seen(way, float(m), root) for way, m, root in zip(ways, misfits, roots, strict=True)]

    def none_is_clearer(self, seen: _Seen) -> bool:
        """Whether turned by quarters about the vertical the mesh, seen as it is, is clearly better understood nowhere.

        Of aside a few vertices tell where it is plain; from behind a body that raises its hands looks much the same.
        """
        aside = [_about_vertical(angle) for angle in (-np.pi / 2, np.pi / 2)]
        others = [self.behind]
        if not all(_SURELY * seen.misfit <= other.misfit for other in self.seen(aside, _FIRST_VERTICES)):
            others += self.seen(aside)
        return all(seen.misfit <= _CLEARLY * other.misfit for other in others)

    def best_of(self, ranked: Sequence[_Seen]) -> _Seen:
        """The way with the least misfit of those that a few vertices rank first."""
        likely = sorted(ranked, key=lambda way: way.misfit)[:_KEPT]
        return min(self.seen([each.way for each in likely]), key=lambda way: way.misfit)

    def turned(self, found: _Seen, undone: Callable[[_Seen], NDArray[np.float64]]) -> _Seen:
        """The way turned by what undoes the root's turn, as far as the network can say."""
        for _ in range(_TURNS):
            turn = undone(found)
            if np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)) < _SETTLED:
                break
            found = self.seen([turn @ found.way])[0]
        return found

    def ahead(self, found: _Seen) -> _Seen:
        """The way turned about the vertical until the body faces +Z."""
        return self.turned(found, lambda found: _about_vertical(-found.facing))

    def faced(self, found: _Seen) -> _Seen:
        """The way turned about the vertical until the body faces +Z; left where that is misread, as where it leans."""
        ahead = self.ahead(found)
        return ahead if ahead.misfit <= max(KNOWN, found.misfit) else found


def _is_straight(root: NDArray[np.float64]) -> bool:
    return abs(_facing(root)) <= _STRAIGHT


def _facing(root: NDArray[np.float64]) -> float:
    """The angle of a rotation [3, 3] about the vertical, in radians from +Z to +X."""
    return float(np.arctan2(root[0, 2] - root[2, 0], root[0, 0] + root[2, 2]))


def _leaning(root: NDArray[np.float64]) -> float:
    """The angle between what a rotation [3, 3] makes of the vertical and the vertical, in radians."""
    return float(np.arccos(np.clip(root[1, 1], -1, 1)))


def _upward() -> list[NDArray[np.float64]]:
    """The least turns [3, 3] that bring each of 26 directions upward: six along the axes, then midway between them."""
    directions = [np.array(signs) for signs in product((0.0, 1.0, -1.0), repeat=3) if any(signs)]
    directions.sort(key=lambda direction: float(np.abs(direction).sum()))
    return [Rotation.align_vectors([[0, 1, 0]], [each])[0].as_matrix() for each in directions]


def _about_vertical(angle: float) -> NDArray[np.float64]:
    return _turn(np.array([0.0, 1.0, 0.0]), angle)


def _turn(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    return Rotation.from_rotvec(angle * axis).as_matrix()


def _probe(mesh: Floats) -> Floats:
    """Some vertices, the same each time, however it is turned and whatever lies first in the file.

    The first of them lie evenly on the surface, and are much the same in other poses: they are drawn one after another,
    each by the area around it (Efraimidis and Spirakis 2006), so that finely meshed hands do not stand for a body. One
    that lies far from all others counts as little more than the rest.
    """
    random = np.random.default_rng(0)
    some = mesh[random.permutation(len(mesh))[:_LOOKED_AT]]
    drawn = np.nan_to_num(some[:_DRAWN], nan=0.0, posinf=0.0, neginf=0.0)
    away = cKDTree(drawn).query(drawn, k=[min(_AROUND, len(drawn))])[0][:, 0]
    areas = np.square(np.clip(away, 1e-15, max(_FAR * float(np.median(away)), 1e-15)))
    order = np.argsort(random.exponential(size=len(drawn)) / areas)
    return np.concatenate([some[order], some[_DRAWN:]])


def _boxed(probe: Floats, vertices: int = _VERTICES) -> Floats:
    """Some of the vertices in the box of all."""
    return bounding_box(probe).normalise(probe)[:vertices]
