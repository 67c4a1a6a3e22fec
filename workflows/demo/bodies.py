"""Made-up people and animals for the page: identities that no training saw, in poses between random ones.

People are Anny's, of the phenotypes that the sliders say; animals are the CC0 ones with other proportions, and are
offered only where their files already are. Poses come from the distributions of the recipes ``human`` and ``animals``,
with a seed of the page's own.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from datagen.bodies import BodyModel, load_body
from datagen.characters import cc0_animals
from datagen.mesh.geometry import Mesh, standing_point
from datagen.poses import Poses, draw_poses
from datagen.recipe import AnnyBody, AnnyTopology, ClipPoses, NptPoses, PoseRecipe, RiggedBody

PERSON, ANIMAL = "person", "animal"
LAST_POSE = 200
SPECIES = cc0_animals.NAMES
DETAILS: dict[str, AnnyTopology] = {
    "12,272 vertices": "notoes",
    "615 vertices": "notoes_collapse5pc",
    "1,229 vertices": "notoes_collapse10pc",
    "13,718 vertices": "anny",
}
ANIMALS_MISSING = (
    "Animals need files that are fetched once: `python -c 'from datagen.characters.cc0_animals import animal_files; "
    "animal_files()'`, then start the page again (docs/bodies/rigged.md)."
)
_SEED = 20_000  # no recipe of the project draws from it
_WALK, _STEPS = 3, 12  # poses of a walk, and frames from one to the next
_DISTRIBUTIONS = {PERSON: NptPoses(), ANIMAL: ClipPoses(path="animals", jitter=0)}


@dataclass(frozen=True)
class Figure:
    """A made-up body.

    ``parameters`` are the body model's; ``pose``: 0 is at rest, 1 to LAST_POSE are random poses, and what lies between
    two whole numbers lies on the way from the one to the other. ``topology`` is a person's mesh.
    """

    kind: str
    parameters: tuple[float, ...]
    pose: float
    topology: AnnyTopology = "notoes"

    @property
    def name(self) -> str:
        """What messages call it, and its file."""
        what = SPECIES[int(self.parameters[0])] if self.kind == ANIMAL else self.kind
        return f"{what}-pose-{self.pose:g}"


def animals_are_there() -> bool:
    """Whether animals can be made without fetching anything."""
    return cc0_animals.are_there()


def parameter_names(kind: str) -> tuple[str, ...]:
    """The parameters that a slider each is for; an animal's first, its species, is none of them."""
    names = _body(kind, "notoes").parameter_names
    return names[1:] if kind == ANIMAL else names


def mesh_of(figure: Figure) -> Mesh:
    """The figure's mesh: metres, Y up, facing +Z, standing on the ground at the origin."""
    body, parameters = _body(figure.kind, figure.topology), np.array(figure.parameters)
    vertices = body.vertices(parameters, _pose(figure.kind, figure.pose))[0]
    return Mesh((vertices - standing_point(vertices)).astype(np.float32), body.faces(parameters))


def truth_of(source: Figure, target: Figure) -> Mesh | None:
    """The target's identity in the source's pose; None where a pose of the one says nothing of the other."""
    return mesh_of(replace(target, pose=source.pose)) if source.kind == target.kind else None


def walk(figure: Figure) -> list[Figure]:
    """The figure on its way from its pose through the next random ones."""
    return [replace(figure, pose=round(figure.pose + step / _STEPS, 4)) for step in range(_WALK * _STEPS + 1)]


def random_figure(kind: str, random: np.random.Generator, topology: AnnyTopology = "notoes") -> Figure:
    """A figure of any identity in any pose."""
    drawn = _body(kind, topology).draw_identity(random, int(random.integers(len(SPECIES))))
    return Figure(kind, tuple(np.round(drawn, 2).tolist()), float(random.integers(1, LAST_POSE + 1)), topology)


def _pose(kind: str, number: float) -> Poses:
    """One pose: at rest, a random one, or on the way, on which every joint starts and ends gently."""
    whole = int(number)
    drawn = draw_poses(PoseRecipe(distribution=_DISTRIBUTIONS[kind], seed=_SEED), range(whole, whole + 2))
    if whole == 0:
        drawn.rotations[0] = 0
    share = number - whole
    begin, end = (Rotation.from_rotvec(rotations) for rotations in drawn.rotations)
    moment = begin * (begin.inv() * end) ** (share * share * (3 - 2 * share))
    return Poses(drawn.joints, drawn.parents, moment.as_rotvec()[None])


def _body(kind: str, topology: AnnyTopology) -> BodyModel:
    return load_body(AnnyBody(topology=topology) if kind == PERSON else RiggedBody(path="animals"))
