"""The study of generalisation: its files, what it prints."""

import argparse
from collections.abc import Iterable, Sequence

from datagen.common.errors import RecipeError
from datagen.recipe import DatasetRecipe
from datagen.recipe.base import LARGEST
from training.evaluation.document import Table, Text, document_markdown, plain
from training.evaluation.generalisation import (
    GeneralisationRow,
    MeshKind,
    cases_between,
    grid_table,
    have_truth,
    measured,
    pairs_with_truth,
)
from training.evaluation.robustness import NO_OP, Case, methods_in
from training.objectives import PMD_UNIT
from training.reports.plots.generalisation import Shown, generalisation_picture, heat_map
from workflows.pipeline.progress import bar
from workflows.pipeline.ray_cluster import require_reachable
from workflows.pipeline.stage import say
from workflows.pipeline.weights_argument import Evaluated
from workflows.recipe.loader import load_recipe
from workflows.studies.common import Study, about_weights, folder_of, methods_of, metric_name, weights_of
from workflows.studies.mesh_kinds import imported_kind, make_kinds, own_kind, own_recipe
from workflows.studies.sizes import Sizes

_FIRST_RECIPE = "quickstart"


class GeneralisationStudy(Study[GeneralisationRow]):
    """Weights on transfers between kinds of meshes, whose datasets are made below the study's folder.

    Raises
    ------
    RecipeError
        An option is invalid, two kinds have one name, or the folder holds other work.
    CheckpointError, DatasetError
        Weights or evaluation triples are missing.
    """

    name, row = "generalisation", GeneralisationRow
    pictures = ("heat-map.png", "examples.png")

    def __init__(self, options: argparse.Namespace) -> None:
        self.sizes = sizes = _sizes(options)
        self.weights = weights_of(options)
        base, self.methods = _base(options, self.weights), methods_of(self.weights)
        self.folder = folder_of(options, self.weights, self.name)
        self._extra = [imported_kind(require_reachable(url, option="--data", urls=True)) for url in options.data]
        self._asked = base, options.topologies, options.others, self.folder / "data", sizes

    def prepare(self) -> None:
        self.kinds = _named_apart([*make_kinds(*self._asked, say=say), *self._extra])
        self.names = [kind.name for kind in self.kinds]
        self.trained = [_trained(each, self.kinds) for each in self.weights]
        self.settings = {
            "weights": about_weights(self.weights),
            "methods": [method.name for method in self.methods],
            "kinds": {kind.name: kind.dataset.uuid for kind in self.kinds},
            "triples": self.sizes.triples,
        }

    def measure(self, done: list[GeneralisationRow]) -> Iterable[list[GeneralisationRow]]:
        found = measured(self.methods, self.kinds, triples=self.sizes.triples, done=done)
        return bar(found, total=len(pairs_with_truth(self.kinds)), what="generalise", unit="pair")

    def draw(self, rows: list[GeneralisationRow]) -> None:
        title = f"PMD (1e-4), {self.sizes.triples} transfers a cell; frame: as trained; last line: the target unchanged"
        heat_map(rows, self.names, self.folder / "heat-map.png", title=title, trained=self.trained)
        shown = examples(self.kinds, self.trained[0] or self.names[0])
        title = "Transfers between kinds of meshes: the first of each pair's list, not chosen by result"
        generalisation_picture(shown, self.methods, self.folder / "examples.png", title=title)

    def metrics(self, rows: list[GeneralisationRow]) -> dict[str, float]:
        """PMD (1e-4) of each method over all pairs between kinds, and within them."""
        values: dict[str, list[float]] = {}
        for row in rows:
            if row.method != NO_OP:
                where = "within" if row.source_kind == row.target_kind else "between"
                values.setdefault(f"pmd/{where}/{metric_name(row.method)}", []).append(row.pmd / PMD_UNIT)
        return {name: sum(numbers) / len(numbers) for name, numbers in values.items()}

    def report(self, rows: list[GeneralisationRow]) -> str:
        """What was done, and a grid of each method."""
        sizes = self.sizes
        whose = "; ".join(
            f"{plain(method.name)}: step {method.step:,}, trained on {plain(own) or 'none of these kinds'}"
            for method, own in zip(self.methods, self.trained, strict=True)
        )
        about = (
            f"Weights: {whose}. {sizes.identities} new identities in "
            f"{sizes.poses} new poses of each kind, {sizes.triples} transfers a pair (a dataset of your own: its own "
            "triples). All Anny kinds are the same people; the stand-in in SMPL's format has people of its own in the "
            "same poses; animals have poses of their own, so that between them and people there is no ground truth. "
            "PMD: mean over vertices and coordinates of (output - truth)^2 in the normalised box; mm: mean distance of "
            "a vertex. Pairs down to across: source to target; –: no ground truth is known, or the network takes "
            "no other vertex count."
        )
        pictures = Text("![heat map](heat-map.png)\n\n![examples](examples.png)")
        grids = [part for name in methods_in(rows) for part in _grids(rows, self.names, name)]
        return document_markdown("Generalisation to other bodies and vertex counts", (Text(about), pictures, *grids))


def _sizes(options: argparse.Namespace) -> Sizes:
    if options.identities < 2 or options.poses < 2 or options.triples < 1 or options.seed < 0:
        raise RecipeError(
            f"--identities {options.identities} --poses {options.poses} --triples {options.triples} "
            f"--seed {options.seed}: a transfer needs two identities and two poses; use 2, 2, 1, 0 or more"
        )
    if max(options.identities, options.poses, options.triples, options.seed) > LARGEST:
        raise RecipeError("--identities, --poses, --triples and --seed have 18 digits at most")
    return Sizes(options.identities, options.poses, options.triples, options.seed)


def _base(options: argparse.Namespace, weights: Sequence[Evaluated]) -> DatasetRecipe:
    if options.recipe:
        return load_recipe(options.recipe).data
    own = own_recipe(weights[0].home)
    if own is None:
        say(f"generalisation: the dataset of {weights[0].home} is not there; people and poses of {_FIRST_RECIPE}")
    return own or load_recipe(_FIRST_RECIPE).data


def _named_apart(kinds: Sequence[MeshKind]) -> Sequence[MeshKind]:
    names = [kind.name for kind in kinds]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise RecipeError(f"two datasets would both be called {twice[0]!r}. Name each once, or rename a folder")
    return kinds


def _trained(weights: Evaluated, kinds: Sequence[MeshKind]) -> str:
    """The kind that weights were trained on, empty where it is none of these or not known."""
    own = own_recipe(weights.home)
    return own_kind(own, kinds) if own else ""


def examples(kinds: Sequence[MeshKind], trained: str) -> list[Shown]:
    """Transfers to draw: to and from every other kind in turn, and, where truth lies in a kind alone, within it."""
    own = next(kind for kind in kinds if kind.name == trained)
    found = []
    for number, kind in enumerate(each for each in kinds if each is not own):
        if have_truth(own, kind):
            pairs = [(own, kind) if number % 2 == 0 else (kind, own)]
        else:
            pairs = [(kind, kind), (own, kind), (kind, own)]
        found += [_shown(source, target) for source, target in pairs]
    return found or [_shown(own, own)]


def _shown(source: MeshKind, target: MeshKind) -> Shown:
    label = f"{_in_lines(source.name)}\nto\n{_in_lines(target.name)}"
    if have_truth(source, target):
        return Shown(label, cases_between(source, target, 1)[0])
    (pose_from,), (body_from,) = cases_between(source, source, 1), cases_between(target, target, 1)
    without = Case(0, pose_from.triple, pose_from.source, body_from.target, body_from.target)
    return Shown(label, without, truth_known=False)


def _in_lines(name: str) -> str:
    return name if len(name) < 13 else "\n".join(name.rsplit(" ", 1))


def _grids(rows: Sequence[GeneralisationRow], kinds: Sequence[str], method: str) -> list[Text | Table]:
    metres = grid_table(rows, kinds, method, field="millimetres", unit=1)
    return [Text(f"## {plain(method)}\n\nPMD x1e-4"), grid_table(rows, kinds, method), Text("mm"), metres]
