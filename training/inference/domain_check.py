"""Where a mesh is unlike what a network was trained on, in words that say what to do.

What the network saw is noted in the run when training begins, and goes into the registry with its weights; weights
without a note are judged by what holds for any.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from datagen.common.arrays import Floats
from datagen.common.errors import DsffnetError
from datagen.mesh.geometry import InFaces, Mesh, bounding_box, edges_of, places_of
from training.inference.orientation import POOR_ERROR, TURN, Axes, Orientation, axes_as_options
from training.inference.standing import MISREAD, Standing
from training.tracking.provenance import FILE, Provenance, provenance_of

if TYPE_CHECKING:
    from datagen.store import Dataset

POOR = "The result may be poor; look at --picture"
_FEWEST = 72  # vertices: three of each of the 24 parts that people have
_TIMES_AS_MANY = 10.0  # vertices than training saw
_PROPORTIONS_BEYOND = 1.5  # times the range of training
_STRAY_SHARE, _STRAY_TIMES = 0.01, 2.0  # so few vertices that make the box so many times larger
_FLAT = 0.02  # shortest over longest edge of the box
_TORN_TIMES, _TORN_SHARE = 4.0, 0.25  # an edge so many times as long as it was, and so much of the longest of the box
_MAIN_SHARE = 0.5  # of the vertices, in the largest connected part
_IDENTITIES_LOOKED_AT, _POSES_LOOKED_AT = 16, 64
"""Of a dataset; with 3 poses 505 of 6,800 meshes of the quickstart's own evaluation passed for ill-proportioned, with
16 one, with 64 none."""


@dataclass(frozen=True)
class Seen:
    """What a network was trained on: fewest and most vertices, and box edges [3] over the longest, least and most."""

    vertices: tuple[int, int]
    least: Floats
    most: Floats


def seen_in(dataset: "Dataset") -> Seen:
    """What a network sees that is trained on a dataset: vertices of all training identities, boxes of some meshes."""
    identities = list(dataset.identities("training"))
    counts = [dataset.vertex_count(who) for who in identities]
    looked_at = [identities[place] for place in _spread(len(identities), _IDENTITIES_LOOKED_AT)]
    shapes = np.array([_proportions(mesh) for who in looked_at for mesh in _some_poses(dataset, who)])
    return Seen((min(counts), max(counts)), shapes.min(axis=0), shapes.max(axis=0))


def noted(seen: Seen) -> dict[str, Any]:
    """Return what a run writes down under ``seen`` in its provenance.json; ``proportions`` are least and most."""
    return {"vertices": list(seen.vertices), "proportions": [seen.least.tolist(), seen.most.tolist()]}


def seen_by(weights: Path) -> Seen | None:
    """What the network of a run saw, None where it cannot be had; ``weights`` is a checkpoint's folder or file."""
    try:
        note = _provenance(weights).get("seen")
        return _from_note(note) if note is not None else None
    except (OSError, OverflowError, ValueError, TypeError, KeyError, DsffnetError):  # half a note is none
        return None


def _provenance(weights: Path) -> Provenance:
    start = weights.absolute()
    for folder in (start, *start.parents):
        if (folder / FILE).exists():
            return provenance_of(folder)
        if folder not in (start, start.parent) and folder.name != "checkpoints":
            break
    raise KeyError("provenance")


def _from_note(note: dict[str, Any]) -> Seen:
    fewest, most = note["vertices"]
    return Seen((int(fewest), int(most)), *np.array(note["proportions"], np.float64).reshape(2, 3))


def _some_poses(dataset: "Dataset", identity: int) -> Floats:
    poses = dataset.grid.poses_of(identity)
    return dataset.vertices(identity, poses[_spread(len(poses), _POSES_LOOKED_AT)])


def _spread(count: int, wanted: int) -> NDArray[np.int64]:
    """Some places of ``count``, evenly spread over all."""
    return np.unique(np.linspace(0, count - 1, wanted).astype(np.int64))


def remarks(
    mesh: Mesh,
    *,
    name: str,
    axes: Axes | Standing,
    way: Orientation | None,
    both: tuple[Axes, Axes] | None,
    stated: bool,
    seen: Seen | None,
    doubt: str = "",
) -> Iterator[str]:
    """One line for everything about a mesh that its network has not met.

    Parameters
    ----------
    mesh
        As it is in its file.
    name
        What the lines call it.
    axes, way, both, stated
        How it is taken to stand, how well it comes back in every way of standing, how source and target seem to stand,
        and whether a person said how. A network that finds by itself how meshes stand needs neither way nor both.
    seen
        What the network saw, None where that is not known.
    doubt
        Why the mesh may be no body that a network which finds how it stands knows; by default its rest error says so.
    """
    upright = axes.upright(mesh.vertices)
    if isinstance(axes, Standing):
        fits, line = not doubt and axes.rest_error <= MISREAD, doubt or _about_a_stranger(name, axes)
    elif way is None:
        fits, line = True, ""
    else:
        fits = way.error(axes) <= POOR_ERROR if stated else way.fits(axes)
        line = "" if fits else _about_standing(name, axes, way, None if stated else both)
    if not fits:
        yield line
    if not (fits and isinstance(axes, Standing)):  # what is understood may be of many parts: clothes, hair, eyes
        yield from _about_parts(name, mesh)
    yield from _about_box(name, upright, seen if fits else None)
    if isinstance(axes, Standing):  # a network that reads a sample of the surface does not mind how many there are
        yield from _about_few(name, mesh.vertices, seen)
    else:
        yield from _about_count(name, len(upright), seen)


def about_loose(loose: NDArray[np.integer], *, name: str) -> str:
    """Return what to say of vertices [n], by number, of a mesh called ``name`` that are in no face."""
    are = "is 1 vertex" if len(loose) == 1 else f"are {len(loose):,} vertices"
    return (
        f"in {name} {are} in no face (number {loose[0]}{' the first' if len(loose) > 1 else ''}, counted from 0): not "
        "read, and moved as the nearest that is in one"
    )


class Tears:
    """Finds edges of a target that transfers pull across the body, as they do a skirt's; not gaps at doubled vertices.

    Of thirty strange meshes that were looked at, these limits pass all but the one that was torn
    (docs/results/parts.md).
    """

    def __init__(self, target: Mesh) -> None:
        self._edges = edges_of(target.faces)
        self._before = np.maximum(self._lengths(target), 1e-12)
        self._size = float(np.ptp(InFaces(target).mesh.vertices, axis=0).max())

    def _lengths(self, mesh: Mesh) -> Floats:
        ends = mesh.vertices[self._edges].astype(np.float64)
        return np.asarray(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))

    def lengths(self, posed: Mesh) -> Floats:
        """Return the lengths [torn] of an output's torn edges, the target's longest extent being 1."""
        after = self._lengths(posed)
        return after[(after > _TORN_TIMES * self._before) & (after > _TORN_SHARE * self._size)] / self._size

    def in_output(self, posed: Mesh, *, name: str) -> str:
        """Return what to say of an output, called ``name``, in the target's unit; "" where it is not torn."""
        torn = self.lengths(posed)
        if not len(torn):
            return ""
        edges = "one of its edges is" if len(torn) == 1 else f"{len(torn):,} of its edges are"
        return (
            f"{name} comes out torn: {edges} more than {_TORN_TIMES:g} times as long, the longest {torn.max():.0%} of "
            "the body, as a skirt's between the legs; look at --picture"
        )


def _about_a_stranger(name: str, found: Standing) -> str:
    return (
        f"{name} is unlike the bodies of training, however it is turned (misread by {found.rest_error:.0f} degrees, "
        f"more than {MISREAD:g}). {POOR}"
    )


def _about_standing(name: str, axes: Axes, way: Orientation, both: tuple[Axes, Axes] | None) -> str:
    """What speaks against a mesh that stands by ``axes``; how it stands is said only where it is certain."""
    if both and way.is_certain:
        return (
            f"{name} seems to stand {way.axes}, to within {TURN:.0f} degrees about the vertical, the training data "
            f"{axes}: add --align, or {axes_as_options(*both)}"
        )
    if way.error(axes) > POOR_ERROR:
        return (
            f"{name} comes back from the network as another shape (PMD {way.error(axes):.3f} onto itself): it is "
            f"unlike the bodies of training, or does not stand {axes}, or is turned about the vertical. {POOR}"
        )
    how = "may be turned about the vertical" if way.is_between else f"may not stand {axes}"
    return (
        f"{name} {how}: it comes back from the network better when it is turned otherwise, but no way is certain. "
        f"{POOR}"
    )


def _about_parts(name: str, mesh: Mesh) -> Iterator[str]:
    sizes = part_sizes(mesh)
    if len(mesh.faces) and sizes[0] <= _MAIN_SHARE * sizes.sum():
        yield (
            f"{name} has {len(sizes)} separate parts, the largest with {sizes[0] / sizes.sum():.0%} of the vertices: "
            "one body is posed as a whole; save it by itself, or choose it by --source-geometry or --target-geometry "
            "where the file has names"
        )


def part_sizes(mesh: Mesh) -> NDArray[np.int64]:
    """Vertices in each connected part, most first; vertices at one place count as one, as at the seams of textures."""
    place_of = places_of(mesh.vertices)
    edges, count = edges_of(place_of[mesh.faces]), int(place_of.max()) + 1
    links = csr_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    return np.sort(np.bincount(connected_components(links, directed=False)[1]))[::-1]


def _about_box(name: str, upright: Floats, seen: Seen | None) -> Iterator[str]:
    shape, strays = _proportions(upright), _strays(upright)
    if strays:
        far = "1 vertex" if strays == 1 else f"{strays} vertices"
        yield f"{name} has {far} far from all others, so that the body is small in its box: remove what is there"
    elif shape.min() < _FLAT:
        yield f"{name} is nearly flat (box {_as_text(shape)} of its longest edge): is one of its axes lost?"
    elif seen and _is_beyond(shape, seen):
        yield (
            f"{name} has a box of {_as_text(shape)} (width, height, depth over the longest), training saw "
            f"{_as_text(seen.least)} to {_as_text(seen.most)}: expect less, or train on such bodies"
        )


def _is_beyond(shape: Floats, seen: Seen) -> bool:
    return bool((shape > seen.most * _PROPORTIONS_BEYOND).any() or (shape < seen.least / _PROPORTIONS_BEYOND).any())


def _about_count(name: str, count: int, seen: Seen | None) -> Iterator[str]:
    if seen is None:
        return
    fewest, most = seen.vertices
    if count > most * _TIMES_AS_MANY or count < fewest / _TIMES_AS_MANY:
        known = f"{fewest:,}" if fewest == most else f"{fewest:,} to {most:,}"
        yield (
            f"{name} has {count:,} vertices, training saw {known}: its surface may come out dented; add --refine, "
            "or train on bodies of about as many"
        )


def _about_few(name: str, vertices: Floats, seen: Seen | None) -> Iterator[str]:
    count, fewest = len(np.unique(vertices, axis=0)), min(_FEWEST, seen.vertices[0] if seen else _FEWEST)
    if count < fewest:
        yield f"{name} has {count} vertices, too few to show how a body stands ({fewest} at least). {POOR}"


def _strays(vertices: Floats) -> int:
    """How many vertices, few as they are, make the box much larger than that of the others; 0 where none do."""
    low, high = np.quantile(vertices, (_STRAY_SHARE / 2, 1 - _STRAY_SHARE / 2), axis=0)
    middle, half = (low + high) / 2, float((high - low).max()) / 2
    if half == 0 or float(bounding_box(vertices).half) < _STRAY_TIMES * half:
        return 0
    return int((np.abs(vertices - middle).max(axis=1) > _STRAY_TIMES * half).sum())


def _proportions(vertices: Floats) -> Floats:
    edges = np.ptp(vertices, axis=0)
    return np.asarray(edges / max(float(edges.max()), 1e-30))


def _as_text(shape: Floats) -> str:
    return " x ".join(f"{edge:.2f}" for edge in shape)
