"""Made-up people and animals for the page: identities that no training saw, bare or in an outfit.

People are Anny's, of the phenotypes that the sliders say; animals are the CC0 ones with other proportions, and are
offered only where their files already are.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from datagen.bodies import BodyModel, load_body, part_labels
from datagen.characters import cc0_animals
from datagen.mesh.geometry import Mesh, standing_point
from datagen.recipe import AnnyBody, AnnyTopology, ClothedBody, RiggedBody
from datagen.recipe.clothed import OUTFITS
from workflows.demo.poses import ANIMAL, LAST_POSE, Pose, poses_of

SPECIES = cc0_animals.NAMES
BARE = "none"
CLOTHES = (BARE, *OUTFITS)
DETAILS: dict[str, AnnyTopology] = {
    "12,272 vertices": "notoes",
    "615 vertices": "notoes_collapse5pc",
    "1,229 vertices": "notoes_collapse10pc",
    "13,718 vertices": "anny",
}
ANIMALS_MISSING = (
    "Animals need files that are fetched once: `dsffnet stand-in animals --out animals`. Then load this page again "
    "(docs/bodies/rigged.md)."
)


@dataclass(frozen=True)
class Figure:
    """A made-up body.

    ``parameters`` are the body model's; ``topology`` and ``outfit`` are a person's.
    """

    kind: str
    parameters: tuple[float, ...]
    pose: Pose = field(default_factory=Pose)
    topology: AnnyTopology = "notoes"
    outfit: str = BARE

    @property
    def name(self) -> str:
        """What messages call it, and its file."""
        what = SPECIES[int(self.parameters[0])] if self.kind == ANIMAL else self.kind
        worn = "" if self.outfit == BARE else f"-{self.outfit}"
        return f"{what}{worn}-{self.pose.name}"

    @property
    def is_clothed(self) -> bool:
        """Whether it wears an outfit."""
        return self.outfit != BARE


def parameter_names(kind: str) -> tuple[str, ...]:
    """The parameters that a slider each is for; an animal's first, its species, is none of them."""
    names = _body(Figure(kind, ())).parameter_names
    return names[1:] if kind == ANIMAL else names


def mesh_of(figure: Figure, *, draped: bool = False) -> Mesh:
    """The figure's mesh: metres, Y up, facing +Z, standing on the ground at the origin.

    Garments follow the skin below them, as at rest they do exactly; ``draped``: as cloth, which takes a second or two.
    """
    body, parameters = _body(figure, draped=draped), _parameters(figure)
    vertices = body.vertices(parameters, poses_of(figure.kind, figure.pose))[0]
    return Mesh((vertices - standing_point(vertices)).astype(np.float32), body.faces(parameters))


def truth_of(source: Figure, target: Figure) -> Mesh | None:
    """The target's identity in the source's pose; None where a pose of the one says nothing of the other."""
    if source.kind != target.kind:
        return None
    return mesh_of(replace(target, pose=source.pose), draped=target.is_clothed)


def garments_of(figure: Figure) -> NDArray[np.integer] | None:
    """What each vertex [v] belongs to, 0 skin, from 1 on the parts of the outfit; None of a bare body."""
    return part_labels(_body(figure), _parameters(figure))


def walk(figure: Figure) -> list[Figure]:
    """The figure in the poses that are played, from its own on."""
    return [replace(figure, pose=pose) for pose in figure.pose.on_the_way()]


def random_figure(kind: str, random: np.random.Generator, topology: AnnyTopology = "notoes") -> Figure:
    """A figure of any identity in any random pose."""
    drawn = _body(Figure(kind, (), topology=topology)).draw_identity(random, int(random.integers(len(SPECIES))))
    pose = Pose(float(random.integers(1, LAST_POSE + 1)))
    return Figure(kind, tuple(np.round(drawn, 2).tolist()), pose, topology)


def _parameters(figure: Figure) -> NDArray[np.float64]:
    worn = (list(OUTFITS).index(figure.outfit), 1.0) if figure.is_clothed else ()  # 1.0: as wide as the outfit says
    return np.array([*figure.parameters, *worn], np.float64)


def _body(figure: Figure, *, draped: bool = False) -> BodyModel:
    if figure.kind == ANIMAL:
        return load_body(RiggedBody(path="animals"))
    person = AnnyBody(topology=figure.topology)
    if not figure.is_clothed:
        return load_body(person)
    return load_body(ClothedBody(body=person, outfits=tuple(OUTFITS), method="draped" if draped else "skinned"))
