"""Licence-free stand-ins of SMPL, SMPL-H, SMPL-X and SMAL: files of the same layout, for trying everything out.

They are *not* the licensed models: other vertices, other shape spaces, no learnt pose correctives. But the files have
the same keys, joints and trees, so that every path through the code is the one that a licensed file takes.

People are made from Anny (code Apache-2.0, assets CC0): its T-pose over a population of adults, by principal
components. SMPL-H and SMPL-X have Anny's fingers; SMPL's hand joints carry the fingers but the thumb. SMPL-X' jaw and
eyes move nothing and its expressions are zero, for that is nothing that Anny's rig has. Pose blend shapes are zero:
Anny has none. The animal is procedural (:mod:`datagen.bodies.standins.quadruped`).
"""

from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from datagen.bodies.anny.model import AnnyModel
from datagen.bodies.anny.rigs import Bones
from datagen.bodies.smpl_family.model_file import NOTE, write_model
from datagen.bodies.smpl_family.model_search import FAMILIES
from datagen.bodies.smpl_family.smpl import joint_names
from datagen.bodies.standins.fit import fit_regressor, principal_shapes
from datagen.bodies.standins.quadruped import quadruped
from datagen.common.errors import BodyError
from datagen.common.seeding import Stream, generator
from datagen.mesh.rig import drivers_of
from datagen.poses import JOINTS, PARENTS
from datagen.recipe import AnnyBody, AnnyTopology, PhenotypeRanges

StandInKind = Literal["smpl", "smplh", "smplx", "smal"]

_PEOPLE, _SHAPES, _EXPRESSIONS = 200, 10, 10
_ADULTS = PhenotypeRanges(
    gender=(0.2, 0.8),
    age=(0.6, 0.9),
    muscle=(0.25, 0.75),
    weight=(0.25, 0.75),
    height=(0.4, 0.6),
    proportions=(0.2, 0.8),
)
"""Narrow, as betas of +-4 standard deviations, which NPT draws, are to look human: statures are 1.82 +- 0.07 m."""

_ANIMALS, _ANIMAL_SHAPES = 300, 41


def write_standin(kind: StandInKind, out: Path, *, topology: AnnyTopology = "notoes_collapse10pc") -> Path:
    """Write the stand-in of a model as an .npz in SMPL's layout; the same arguments give the same bytes.

    Parameters
    ----------
    kind
        smpl (24 joints), smplh (52), smplx (55) or smal (35).
    out
        The file, called .npz; its ``note`` says that it is not the licensed model.
    topology
        Anny's mesh, for people.

    Raises
    ------
    BodyError
        Unknown kind, a name that does not end in .npz, or another file of that name is there.
    StorageError
        The file could not be written.
    """
    if out.suffix.lower() != ".npz":
        raise BodyError(f"a stand-in is an .npz, so {out} cannot be its name; try {out.with_suffix('.npz')}")
    write_model(out, standin(kind, topology=topology))
    return out


def standin(kind: StandInKind, *, topology: AnnyTopology = "notoes_collapse10pc") -> dict[str, NDArray[Any]]:
    """The arrays of a stand-in (see :mod:`datagen.bodies.smpl_family.model_file`), in the axes of the model that it
    stands for.

    Raises
    ------
    BodyError
        Unknown kind.
    """
    if kind not in get_args(StandInKind):
        raise BodyError(f"there is no stand-in of {kind!r}; there are {', '.join(get_args(StandInKind))}")
    return _animal() if kind == "smal" else _person(kind, topology)


def _person(kind: StandInKind, topology: AnnyTopology) -> dict[str, NDArray[Any]]:
    body = AnnyModel(AnnyBody(topology=topology, rig="mixamo", phenotypes=_ADULTS))
    people = [body.t_pose(_identity(body, number)) for number in range(_PEOPLE)]
    vertices, heads = (np.stack(parts) for parts in zip(*people, strict=True))
    names = joint_names(kind)
    carried = _by_joint(body.bones, names)
    joints = np.stack([heads[:, _pivots(name, carried)].mean(axis=1) for name in names], axis=1)
    bone_weights = scipy.sparse.csr_array(body.rest(_identity(body, 0)).weights).toarray()
    weights = np.stack([bone_weights[:, carried[name]].clip(0).sum(axis=1) for name in names], axis=1)
    faces = body.faces(_identity(body, 0))
    template, shapes = principal_shapes(vertices, _SHAPES)
    if kind == "smplx":
        shapes = np.concatenate([shapes, np.zeros((*template.shape, _EXPRESSIONS))], axis=-1)
    note = (
        f"NOT the licensed model: a stand-in for {FAMILIES[kind].title} made from Anny by dsffnet; "
        "code Apache-2.0, assets CC0-1.0"
    )
    return _layout(template, shapes, fit_regressor(vertices, joints), weights, _tree(names), faces, note)


def _animal() -> dict[str, NDArray[Any]]:
    animal = quadruped()
    drawn = [animal.drawn(generator(0, Stream.IDENTITY, number)) for number in range(_ANIMALS)]
    vertices, joints = (np.stack(parts) for parts in zip(*drawn, strict=True))
    template, shapes = principal_shapes(vertices, _ANIMAL_SHAPES)
    regressor = fit_regressor(vertices, joints)
    note = "NOT the licensed model: a stand-in for SMAL, a procedural animal made by dsffnet; CC0-1.0"
    return _layout(template, shapes, regressor, animal.weights, animal.parents, animal.faces, note)


def _layout(
    template: NDArray[np.float64],
    shapes: NDArray[np.float64],
    regressor: NDArray[np.float64],
    weights: NDArray[np.float64],
    parents: tuple[int, ...],
    faces: NDArray[np.integer],
    note: str,
) -> dict[str, NDArray[Any]]:
    joints = len(parents)
    return {
        "v_template": template,
        "shapedirs": shapes.astype(np.float32),
        "posedirs": np.zeros((*template.shape, 9 * (joints - 1)), np.float32),
        "J_regressor": regressor,
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.array([parents, range(joints)], np.int64),
        "f": faces.astype(np.uint32),
        NOTE: np.array(note),
    }


def _identity(body: AnnyModel, number: int) -> NDArray[np.float64]:
    return body.draw_identity(generator(0, Stream.IDENTITY, number), number)


def _by_joint(bones: Bones, names: tuple[str, ...]) -> dict[str, list[int]]:
    """Numbers of the bones that each joint carries: its own, and fingers that have no joint of theirs."""
    hands = [label.partition("Hand") for label in bones.labels]
    fingers = [f"{side}_{finger}".lower() for side, _, finger in hands]
    named = [finger if finger in names else joint for finger, joint in zip(fingers, bones.joints, strict=True)]
    drivers = drivers_of(named, bones.parents, names)
    return {name: [bone for bone, its in enumerate(drivers) if its == joint] for joint, name in enumerate(names)}


def _pivots(name: str, carried: dict[str, list[int]]) -> list[int]:
    """The bones in whose heads' middle a joint lies: its first; of a hand, the roots of its fingers."""
    bones = carried[name] or carried["head"]  # jaw and eyes, which Anny's rig lacks
    return bones[::3] if name.endswith("_hand") else bones[:1]


def _tree(names: tuple[str, ...]) -> tuple[int, ...]:
    """Parents of named joints: SMPL's, fingers on their wrists and one after another, jaw and eyes on the head."""
    return tuple(-1 if name == "pelvis" else names.index(_parent(name)) for name in names)


def _parent(name: str) -> str:
    if name in JOINTS:
        return JOINTS[PARENTS[JOINTS.index(name)]]
    if name[-1] in "23":
        return f"{name[:-1]}{int(name[-1]) - 1}"
    return f"{name.partition('_')[0]}_wrist" if name[-1] == "1" else "head"
