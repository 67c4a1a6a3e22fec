"""What a dataset says of its identities beside their meshes: parameters, topologies, rigs.

Tasks describe blocks of identities, which are joined in the order of their numbers: topologies and rigs are numbered as
they appear, whatever the blocks. What a dataset has already is the first block of what it grows to.
"""

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datagen.bodies import BodyModel, load_body, part_labels
from datagen.common.seeding import Stream, generator
from datagen.grid import HOLE, Grid, GridArrays
from datagen.mesh.rig import Rig, Rigs
from datagen.poses import draw_poses, load_poses
from datagen.recipe import DatasetRecipe
from datagen.store import Dataset


@dataclass(frozen=True, eq=False)
class Topology:
    """The mesh that some identities share: triangles [face, 3], its count of vertices, the part of each or None."""

    faces: NDArray[np.int32]
    vertices: int
    labels: NDArray[np.int32] | None


@dataclass(frozen=True, eq=False)
class Identities:
    """A run of identities.

    Attributes
    ----------
    first
        Number of the first of them.
    parameters
        Of the body model, float64 [identity, parameter].
    topologies, topology_numbers
        Those that occur, and which of them each identity has, int32 [identity].
    rigs, rig_numbers
        The rigs of identities whose bodies have the same parts, and which of them each identity belongs to, int32
        [identity]; -1 where its body has no skeleton.
    """

    first: int
    parameters: NDArray[np.float64]
    topologies: list[Topology]
    topology_numbers: NDArray[np.int32]
    rigs: list[Rigs]
    rig_numbers: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def parts(self) -> list[dict[str, Any]]:
        """Names, parents and drivers of the parts of each rig, for the attributes."""
        return [{key: list(getattr(rigs, key)) for key in ("names", "parents", "drivers")} for rigs in self.rigs]

    @property
    def labels(self) -> dict[int, NDArray[np.int32]]:
        """The labels of the topologies that have some, by number."""
        return {number: each.labels for number, each in enumerate(self.topologies) if each.labels is not None}

    def arrays(self, grid: Grid) -> GridArrays:
        """Where the meshes of a grid of these identities go."""
        return GridArrays(grid, self.topology_numbers, [topology.vertices for topology in self.topologies])


def identity_parameters(recipe: DatasetRecipe, body: BodyModel, identity: int) -> NDArray[np.float64]:
    """Parameters [parameter] of identity number ``identity``, a function of (seed, identity) alone."""
    return body.draw_identity(generator(recipe.identities.seed, Stream.IDENTITY, identity), identity)


def describe_identities(url: str, recipe: DatasetRecipe, numbers: range) -> Identities:
    """Describe a run of identities; a task."""
    body, joints = load_body(recipe.body), load_poses(recipe.poses).joints
    topologies, rigs = _Topologies(), _RigTable()
    drawn, topology_numbers, rig_numbers = [], [], []
    for identity in numbers:  # all of a person at once, who may be dear to make
        parameters = identity_parameters(recipe, body, identity)
        faces = body.faces(parameters)
        if (topology := topologies.number_of(faces)) is None:
            topology = topologies.number_in(_topology(recipe, body, identity, parameters, faces))
        drawn.append(parameters)
        topology_numbers.append(topology)
        rig_numbers.append(rigs.add(body.rig(parameters, joints)))
    return Identities(
        first=numbers[0],
        parameters=np.stack(drawn),
        topologies=topologies.found,
        topology_numbers=np.array(topology_numbers, np.int32),
        rigs=rigs.rigs(),
        rig_numbers=np.array(rig_numbers, np.int32),
    )


def _topology(
    recipe: DatasetRecipe, body: BodyModel, identity: int, parameters: NDArray[np.float64], faces: NDArray[np.int32]
) -> Topology:
    """Vertices are counted by their labels, or in a mesh of an identity that has them: some may be in no face."""
    if (labels := part_labels(body, parameters)) is not None:
        return Topology(faces, len(labels), labels)
    one_pose = draw_poses(recipe.poses, Grid(recipe).poses_of(identity)[:1])
    return Topology(faces, body.vertices(parameters, one_pose).shape[1], None)


def stored_identities(dataset: Dataset) -> Identities:
    """The identities of a dataset, as it has them.

    Raises
    ------
    DatasetError
        What says so is missing or damaged, or is not what was committed.
    """
    dataset.require_unchanged()
    arrays, everyone = dataset.arrays, range(dataset.grid.identity_count)
    firsts = np.unique(arrays.topologies, return_index=True)[1].tolist()
    parameters = np.empty((len(everyone), len(dataset.attributes["body"]["parameters"])))
    for array in arrays.arrays:
        there = array.identities != HOLE
        parameters[array.identities[there]] = dataset.parameters_along(array)[there]
    return Identities(
        first=0,
        parameters=parameters,
        topologies=[
            Topology(dataset.faces(identity), arrays.vertices[number], dataset.part(identity))
            for number, identity in enumerate(firsts)
        ],
        topology_numbers=arrays.topologies,
        rigs=[dataset.rigs(number) for number in range(len(dataset.attributes["rigs"]))],
        rig_numbers=dataset.rig_numbers,
    )


def joined(blocks: Iterable[Identities]) -> Identities:
    """All identities of some blocks, which come in any order; none is held longer than those before it take."""
    topologies, rigs = _Topologies(), _RigTable()
    parameters, topology_numbers, rig_numbers = [], [], []
    for block in _in_order(blocks):
        numbers = np.array([topologies.number_in(topology) for topology in block.topologies], np.int32)
        topology_numbers.append(numbers[block.topology_numbers])
        rig_numbers.append(rigs.add_all(block))
        parameters.append(block.parameters)
    return Identities(
        first=0,
        parameters=np.concatenate(parameters),
        topologies=topologies.found,
        topology_numbers=np.concatenate(topology_numbers),
        rigs=rigs.rigs(),
        rig_numbers=np.concatenate(rig_numbers),
    )


def _in_order(blocks: Iterable[Identities]) -> Iterator[Identities]:
    waiting, expected = dict[int, Identities](), 0
    for block in blocks:
        waiting[block.first] = block
        while expected in waiting:
            ready = waiting.pop(expected)
            expected += len(ready)
            yield ready


class _Topologies:
    """Topologies, numbered as they appear."""

    def __init__(self) -> None:
        self.found: list[Topology] = []
        self._numbers: dict[bytes, int] = {}

    def number_of(self, faces: NDArray[np.int32]) -> int | None:
        """The number of the topology that has these triangles; None where there is none yet."""
        if self.found and faces is self.found[-1].faces:  # most bodies have but one, and no need to look at it
            return len(self.found) - 1
        return self._numbers.get(faces.tobytes())

    def number_in(self, topology: Topology) -> int:
        """The number of a topology, which is added where it is the first."""
        number = self.number_of(topology.faces)
        if number is None:
            number = self._numbers[topology.faces.tobytes()] = len(self.found)
            self.found.append(topology)
        return number


class _RigTable:
    """The rigs of identities, which are added one after another; those of the same parts are gathered."""

    def __init__(self) -> None:
        self._kindred: dict[tuple[object, ...], _Kindred] = {}

    def add(self, rig: Rig | None) -> int:
        """The number of the next identity's rig, -1 where its body has none."""
        if rig is None:
            return -1
        kindred = self._of(rig, rig.weights.shape)
        kindred.joints.append(rig.joints[None])
        kindred.kinds.append(np.array([kindred.kind_of(rig.weights)], np.int32))
        return kindred.number

    def add_all(self, block: Identities) -> NDArray[np.int32]:
        """The numbers [identity] of the rigs of a block's identities."""
        numbers = np.full(len(block.rigs) + 1, -1, np.int32)  # the last: of no rig
        for number, rigs in enumerate(block.rigs):
            kindred = self._of(rigs, rigs.weights.shape[1:])
            kinds = np.array([kindred.kind_of(weights) for weights in rigs.weights], np.int32)
            kindred.kinds.append(kinds[rigs.kinds])
            kindred.joints.append(rigs.joints)
            numbers[number] = kindred.number
        return numbers[block.rig_numbers]

    def _of(self, rig: Rig | Rigs, shape: tuple[int, ...]) -> "_Kindred":
        key = rig.names, rig.parents, rig.drivers, rig.corrections.tobytes(), shape
        if key not in self._kindred:
            self._kindred[key] = _Kindred(rig, shape, len(self._kindred))
        return self._kindred[key]

    def rigs(self) -> list[Rigs]:
        """The rigs by number."""
        return [kindred.rigs() for kindred in self._kindred.values()]


class _Kindred:
    """Rigs of the same parts; weights that are the same are kept once, all in one buffer."""

    def __init__(self, like: Rig | Rigs, shape: tuple[int, ...], number: int) -> None:
        self.number, self._shape = number, shape
        self._names, self._parents, self._drivers = like.names, like.parents, like.drivers
        self._corrections = like.corrections
        self.kinds: list[NDArray[np.int32]] = []
        self.joints: list[NDArray[np.float32]] = []
        self._weights = bytearray()
        self._places: dict[bytes, int] = {}
        self._latest: tuple[NDArray[np.float32], int] | None = None

    def kind_of(self, weights: NDArray[np.float32]) -> int:
        """The number of some weights among those that occur."""
        if self._latest is not None and self._latest[0] is weights:
            return self._latest[1]
        content = weights.tobytes()
        kind = self._places.setdefault(hashlib.sha256(content).digest(), len(self._places))
        if kind * len(content) == len(self._weights):
            self._weights += content
        self._latest = weights, kind
        return kind

    def rigs(self) -> Rigs:
        return Rigs(
            names=self._names,
            parents=self._parents,
            drivers=self._drivers,
            corrections=self._corrections,
            weights=np.frombuffer(self._weights, np.float32).reshape(-1, *self._shape),
            kinds=np.concatenate(self.kinds),
            joints=np.concatenate(self.joints),
        )
