"""Which of the weights that come along pose two meshes: those of people, of people in clothes, or of animals."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from datagen.common.errors import MeshError
from datagen.mesh.geometry import Mesh
from training.inference.domain_check import POOR, Tears
from training.inference.orientation import Axes
from training.inference.standing import KNOWN, MISREAD, SURELY_READ, Standing
from training.inference.transfer import PoseTransfer
from workflows.pretrained import KINDS, own_weights
from workflows.transfer.job import TransferJob

Pair = tuple[Standing, Standing]
_WIDE = 1.62
"""How many times the rest error of `dressed` `human` has at least on most who wear wide clothes
(docs/results/transfer.md)."""
_ILL_KNOWN = 1.5 * KNOWN
"""Misfit that `human` leaves on all who wear wide clothes, and not on bare people whom it just reads badly: those whose
limbs touch it still poses better than `dressed` does (docs/results/transfer.md)."""
_LIMIT = {"dressed": 5.0}
"""Degrees of rest error up to which weights read a mesh, where that is not `MISREAD`."""
Load = Callable[..., PoseTransfer]
"""As :meth:`PoseTransfer.from_run`; a process that poses many meshes has one that keeps what it loaded."""


@dataclass(frozen=True)
class Chosen:
    """Weights, their network, and how source and target stand, as the network finds or a person says.

    ``doubts``: of each of the two, why it may be no body at all, or nothing. ``posed``: the target in the source's
    pose, where that was tried. ``is_unrivalled``: whether no others were asked.
    """

    weights: Path
    transfer: PoseTransfer
    standings: Pair
    doubts: tuple[str, str] = ("", "")
    posed: Mesh | None = None
    is_unrivalled: bool = False

    @classmethod
    def of(cls, weights: Path, job: TransferJob, meshes: tuple[Mesh, Mesh], load: Load) -> "Chosen":
        """The weights named so, of a network that finds how meshes stand."""
        transfer = load(weights)
        return cls(weights, transfer, standings(transfer, job, meshes))

    @property
    def is_read(self) -> bool:
        """Whether both meshes are such bodies as the weights know."""
        return all(found.rest_error <= MISREAD for found in self.standings)

    @property
    def is_surely_read(self) -> bool:
        """Whether both meshes are such bodies beyond doubt."""
        return all(found.rest_error <= SURELY_READ for found in self.standings)

    @property
    def is_sure(self) -> bool:
        """Whether both meshes are known well."""
        return self.is_read and all(found.misfit <= KNOWN for found in self.standings)

    def tried(self, meshes: tuple[Mesh, Mesh]) -> "Chosen":
        """The same with the target in the source's pose."""
        (source, target), (source_axes, target_axes) = meshes, self.standings
        posed = self.transfer(source=source, target=target, source_axes=source_axes, target_axes=target_axes)
        return replace(self, posed=posed)

    def torn(self, target: Mesh) -> int:
        """How many edges of the target were torn where it was tried."""
        return 0 if self.posed is None else len(Tears(target).lengths(self.posed))

    def reads_better_than(self, other: "Chosen") -> bool:
        """Whether both meshes have less rest error than by other weights."""
        pairs = zip(self.standings, other.standings, strict=True)
        return all(own.rest_error < theirs.rest_error for own, theirs in pairs)


def standings(transfer: PoseTransfer, job: TransferJob, meshes: tuple[Mesh, Mesh]) -> Pair:
    """How source and target stand: as a person says, or as the network finds."""
    source, target = (
        _standing(transfer, mesh, axes if job.is_told else None)
        for axes, mesh in zip(job.axes or (None, None), meshes, strict=True)
    )
    return source, target


def _standing(transfer: PoseTransfer, mesh: Mesh, axes: Axes | None) -> Standing:
    """How a mesh stands, by ``axes`` where a person says so, and how badly it is read then."""
    if axes:
        found = Standing(axes.matrix, transfer.misfit(axes.turned(mesh.vertices)))
    else:
        stands = transfer.standing(mesh)
        assert isinstance(stands, Standing)
        found = stands
    if not np.isnan(found.rest_error):
        return found
    return replace(found, rest_error=transfer.rest_error(Mesh(found.upright(mesh.vertices), mesh.faces)))


def chosen(job: TransferJob, meshes: tuple[Mesh, Mesh], *, force: bool, load: Load | None = None) -> Chosen:
    """Return the weights that know both meshes best; of meshes that none knows, `human`.

    The others are not asked where `human` knows both well: among all the ways to turn an animal there may be one in
    which it passes for a person, but worse by far than people do. Nor are `animals` where it reads both surely, nor is
    `dressed` where `animals` knows both well, and better than `human` does. But where `human`, sure of both, tears the
    target in the first source's pose, as it may a skirt, and `dressed` reads both and tears at most half as many edges,
    the latter is taken. So it is for people in wide clothes, whom `human` does not know well: where `dressed` reads
    all people, and one of them clearly better than `human` does.

    Raises
    ------
    MeshError
        One is a person and one an animal, and it is not forced.
    """
    load = load or PoseTransfer.from_run
    people = Chosen.of(own_weights("human"), job, meshes, load)
    if people.is_sure:
        people = people.tried(meshes)
        if not (torn := people.torn(meshes[1])):
            return replace(people, is_unrivalled=True)
        dressed = Chosen.of(own_weights("dressed"), job, meshes, load)
        dressed = dressed.tried(meshes) if dressed.is_read else dressed
        return dressed if dressed.is_read and dressed.torn(meshes[1]) <= torn / 2 else people
    animals = None if people.is_surely_read else Chosen.of(own_weights("animals"), job, meshes, load)
    if animals and animals.is_sure and animals.reads_better_than(people):
        return animals
    dressed = Chosen.of(own_weights("dressed"), job, meshes, load)
    every = {"human": people, "dressed": dressed, **({"animals": animals} if animals else {})}
    errors = {name: [found.rest_error for found in each.standings] for name, each in every.items()}
    source, target = kinds = [_kind(errors, place) for place in range(2)]
    if source and target and source != target and not force:
        raise MeshError(
            f"{job.sources[0]} is {source} and {job.target} is {target}: a pose of the one says nothing "
            "of the other. Give two of a kind; or add --force, to see what comes of it"
        )
    kind = target or source or KINDS["human"]
    known = [place for place in range(2) if kinds[place] == kind]
    taken = (
        "dressed" if kind == KINDS["dressed"] and _wear_wide_clothes(people, dressed, known) else _first_of(every, kind)
    )
    why = f"they know {(job.sources[0], job.target)[known[-1]]}" if known else "for every such mesh"
    reason = f"the weights {taken} are taken, as {why}. {POOR}"
    doubts = (
        "" if source else f"{job.sources[0]} is {_neither(errors, 0)}; {reason}",
        "" if target else f"{job.target} is {_neither(errors, 1)}; {reason}",
    )
    return replace(every[taken], doubts=doubts)


Errors = dict[str, list[float]]
"""By how many degrees each weights misread the source and the target."""


def _kind(errors: Errors, place: int) -> str | None:
    """What a mesh is by the weights that read it best, if any reads it."""
    able = [name for name, found in errors.items() if found[place] <= _limit(name)]
    return KINDS[min(able, key=lambda name: errors[name][place])] if able else None


def _wear_wide_clothes(human: Chosen, dressed: Chosen, places: list[int]) -> bool:
    """Whether `dressed` reads all of these people, and one whom `human` knows ill clearly better than that does."""
    pairs = [(human.standings[place], dressed.standings[place]) for place in places]
    read = all(theirs.rest_error <= _limit("dressed") for _, theirs in pairs)
    return read and any(
        own.misfit > _ILL_KNOWN and own.rest_error > min(_WIDE * theirs.rest_error, MISREAD) for own, theirs in pairs
    )


def _first_of(names: Iterable[str], kind: str) -> str:
    return next(name for name in names if KINDS[name] == kind)


def _limit(name: str) -> float:
    return _LIMIT.get(name, MISREAD)


def _neither(errors: Errors, place: int) -> str:
    each = [f"{found[place]:.0f} ({name})" for name, found in errors.items()]
    known = " nor ".join(dict.fromkeys(KINDS.values()))
    misread = f"{', '.join(each[:-1])} and {each[-1]}"
    others = ", ".join(f"{name}: {limit:g}" for name, limit in _LIMIT.items())
    return f"neither {known} as the weights know them: misread by {misread} degrees, more than {MISREAD:g} ({others})"
