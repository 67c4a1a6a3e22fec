"""Datasets of many kinds of meshes in the same poses: Anny's topologies, the stand-in in SMPL's format, animals."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from datagen.bodies.standins.smpl_format import write_standin
from datagen.common.errors import DatasetError, DsffnetError
from datagen.common.printable import printable
from datagen.generate import generate
from datagen.recipe import (
    AnnyBody,
    AnnyTopology,
    ClipPoses,
    DatasetRecipe,
    EvaluationTriples,
    IdentityRecipe,
    NptPoses,
    PoseRecipe,
    RiggedBody,
    SmplBody,
)
from datagen.store import Dataset, open_dataset
from datagen.store.verify import require_recipe
from training.evaluation.generalisation import MeshKind
from training.tracking.provenance import provenance_of
from workflows.studies.sizes import Other, Sizes

_CLIPS = ("attack*", "eating*", "gallop*", "idle*", "jump*", "walk*")  # all but dying, where animals lie
_OF_HUMANS = ("npt", "anatomical", "ranges", "amass")  # poses over SMPL's joints, which all human bodies here take


def own_recipe(home: Path) -> DatasetRecipe | None:
    """The recipe of the dataset that a run was trained on: beside the run, or where it was then; None where neither."""
    try:
        about = provenance_of(home)["dataset"]
        found = (_recipe_at(url, about["uuid"]) for url in (str(home.parent / "dataset.zarr"), about["url"]))
        return next(filter(None, found), None)
    except (OSError, ValueError, KeyError):
        return None


def _recipe_at(url: str, uuid: str) -> DatasetRecipe | None:
    with suppress(OSError, DsffnetError):
        dataset = open_dataset(url)
        return dataset.recipe if dataset.uuid == uuid else None
    return None


def people_recipe(base: DatasetRecipe, topology: AnnyTopology, sizes: Sizes) -> DatasetRecipe:
    """New people of a recipe's distributions, in a topology: the same people and poses whatever the topology.

    Ranges of phenotypes, rig and poses are the recipe's own; those of a recipe of other bodies are the defaults.
    """
    body = base.body if isinstance(base.body, AnnyBody) else AnnyBody()
    return _sized(body.model_copy(update={"topology": topology}), human_poses(base, sizes), sizes)


def animals_recipe(sizes: Sizes) -> DatasetRecipe:
    """The CC0 animals in moments of their own clips."""
    poses = PoseRecipe(seen=sizes.poses, unseen=0, distribution=ClipPoses(clips=_CLIPS), seed=sizes.seed)
    return _sized(RiggedBody(), poses, sizes)


def human_poses(base: DatasetRecipe, sizes: Sizes) -> PoseRecipe:
    """New draws of the recipe's poses, or of NPT's where its own are of other joints."""
    own = base.poses.distribution
    distribution = own if own.name in _OF_HUMANS else NptPoses()
    return PoseRecipe(seen=sizes.poses, unseen=0, distribution=distribution, seed=sizes.seed)


def _sized(body: AnnyBody | SmplBody | RiggedBody, poses: PoseRecipe, sizes: Sizes) -> DatasetRecipe:
    return DatasetRecipe(
        body=body,
        identities=IdentityRecipe(training=0, evaluation=sizes.identities, seed=sizes.seed),
        poses=poses,
        triples=EvaluationTriples(count=sizes.triples, seed=sizes.seed),
    )


def make_kinds(
    base: DatasetRecipe,
    topologies: Sequence[AnnyTopology],
    others: Sequence[Other],
    folder: Path,
    sizes: Sizes,
    *,
    say: Callable[[str], None],
) -> list[MeshKind]:
    """Make what is missing of the kinds' datasets below a folder.

    What cannot be had (animals without a network) is said and left out.
    """
    made = [_kind(people_recipe(base, topology, sizes), folder / f"{topology}.zarr") for topology in topologies]
    for other in others:
        try:
            if other == "smpl":
                made.append(_standin(base, folder, sizes))
            else:
                made.append(_kind(animals_recipe(sizes), folder / "animals.zarr"))
        except DsffnetError as error:
            say(f"left out: {other}: {error}")
    return made


def _standin(base: DatasetRecipe, folder: Path, sizes: Sizes) -> MeshKind:
    model = folder / "smpl-standin.npz"
    if not model.exists():
        write_standin("smpl", model)
    recipe = _sized(SmplBody(path=str(model.absolute())), human_poses(base, sizes), sizes)
    return _kind(recipe, folder / "smpl-standin.zarr")


def _kind(recipe: DatasetRecipe, url: Path) -> MeshKind:
    place = str(url.absolute())
    dataset = generate(recipe, place, fresh=_is_of_another(recipe, place))
    name = f"{_family(recipe)} {_counts(dataset)}"
    return MeshKind(name, dataset, f"{recipe.poses.model_dump_json()} {recipe.identities.evaluation}")


def _is_of_another(recipe: DatasetRecipe, place: str) -> bool:
    """Whether a dataset was made by another recipe, of other sizes, say: a study makes its own data anew then."""
    try:
        return require_recipe(place).sha256() != recipe.sha256()
    except DatasetError:
        return False


def imported_kind(url: str) -> MeshKind:
    """A dataset of a person's own: its poses are its alone."""
    dataset = open_dataset(url)
    name = printable(Path(url).name.removesuffix(".zarr"))
    return MeshKind(f"{name} {_counts(dataset)}", dataset, dataset.uuid)


def own_kind(recipe: DatasetRecipe, kinds: Sequence[MeshKind]) -> str:
    """The name of the kind that has the body of a training's recipe; empty where none has."""
    for kind in kinds:
        body = kind.dataset.recipe.body
        alike = body.family == recipe.body.family and getattr(body, "topology", "") == getattr(
            recipe.body, "topology", ""
        )
        if alike:
            return kind.name
    return ""


def _family(recipe: DatasetRecipe) -> str:
    body = recipe.body
    if isinstance(body, AnnyBody):
        return "SOMA" if body.topology == "soma" else "Anny"
    return {"smpl": "SMPL stand-in", "rigged": "animals"}.get(body.family, body.family)


def _counts(dataset: Dataset) -> str:
    counts = [dataset.vertex_count(identity) for identity in dataset.identities("evaluation")]
    return f"{min(counts):,}" if len(set(counts)) == 1 else f"{min(counts):,}–{max(counts):,}"
