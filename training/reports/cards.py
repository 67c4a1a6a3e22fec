"""Cards: what a dataset and a trained model are, what they are for, and where they end. Parts of a report."""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from datagen.common.files import sha256_of
from datagen.store import Dataset
from datagen.store.verify import describe
from training.checkpoints.checkpoint import Checkpoint, recipe_of, require_checkpoint
from training.checkpoints.folder import AVERAGE, WEIGHTS
from training.evaluation.document import Table, Text, plain
from training.evaluation.evaluate import NO_OPS, POSE_TYPES, Row
from training.evaluation.measure import CONTROLS
from training.evaluation.run_curves import run_curve
from training.evaluation.tables import COLUMNS, mean_of, methods_of, summary
from training.networks import network_from
from training.recipes.networks import NptRecipe, PartsRecipe
from training.recipes.training import TrainingRecipe
from training.reports.blocks import Block, Code, Facts, Picture, Section, shown
from training.reports.card_texts import (
    DATASET_LIMITS,
    DATASET_USE,
    MODEL_LIMITS,
    MODEL_USE,
    NETWORK_LIMITS,
    NETWORKS,
    POSES,
    READS_PARTS,
    SEES_ALL_VERTICES,
    as_yaml,
    family_texts,
    name_of,
    span,
    vertex_counts,
)
from training.reports.run_summary import duration
from training.tracking.journal import read_journal
from training.tracking.provenance import provenance_of
from training.tracking.record import ALIAS, MODEL, flatten, read_record


def model_card(run: Path, dataset: Dataset, rows: Sequence[Row] | None = None) -> Section:
    """What a run's weights are, how they came about, what they score, how they are loaded, and where they end.

    Parameters
    ----------
    run
        The folder of a training, or of a workflow around one.
    dataset
        What it was trained on.
    rows
        Of its evaluation: the model's own and those of the no-op baselines.

    Raises
    ------
    CheckpointError
        The run has no usable checkpoint.
    """
    checkpoint = require_checkpoint(run, "result")
    recipe = recipe_of(checkpoint)
    home = checkpoint.path.parent.parent if checkpoint.path.parent.name == "checkpoints" else run
    body: list[Block] = [Facts(_model_facts(checkpoint, recipe, dataset, home)), _changed(recipe)]
    body.append(Code(as_yaml({"training": recipe.model_dump(mode="json")}), folded="The whole training recipe"))
    body += _results(list(rows or ()))
    how_it_sees = READS_PARTS if isinstance(recipe.network, PartsRecipe) else SEES_ALL_VERTICES
    limits = how_it_sees.format(vertices=span(vertex_counts(dataset, "training")))
    limits += "\n" + MODEL_LIMITS.format(network=_network_limits(recipe))
    licences = ", ".join(dict.fromkeys(plain(asset["licence"]) for asset in dataset.attributes["body"]["assets"]))
    body += [
        Text(f"### Intended use\n\n{MODEL_USE}\n\n### Limits\n\n{limits}{_worse_than_nothing(list(rows or ()))}"),
        Text(
            "### Licences\n\nThe code is under Apache-2.0. The weights come from the dataset above, whose assets are "
            f"under: {licences}. Terms of assets that reach to what is made from them hold for the weights too."
        ),
        Text("### To use it"),
        Code(_usage(home)),
    ]
    return Section("Model card", tuple(body))


def _model_facts(
    checkpoint: Checkpoint, recipe: TrainingRecipe, dataset: Dataset, home: Path
) -> dict[str, str | int | float | Code]:
    rows, provenance = read_journal(home / "metrics.jsonl"), provenance_of(home)
    weights = checkpoint.path
    if not weights.is_file():
        weights /= AVERAGE if checkpoint.has_average else WEIGHTS
    count = _parameter_count(recipe)
    clock = run_curve(rows, "meshes_per_second", batch=recipe.batch)
    hardware = "; ".join(provenance.get("hardware", {}).values()) or provenance.get("machine", "")
    ranks = f"{recipe.ranks} rank{'s' if recipe.ranks > 1 else ''}"
    facts: dict[str, str | int | float | Code] = {
        "network": _network_words(recipe),
        "parameters": f"{count:,} ({count * 4 / 1024:,.0f} KiB in float32)",
        "weights": f"{weights.relative_to(home).as_posix() if home in weights.parents else weights.name}"
        f", step {checkpoint.step:,}",
        "sha256 of the weights": Code(sha256_of(weights)),
        "trained on": name_of(dataset) if checkpoint.dataset == dataset.uuid else "other data than this report's",
        "uuid of the data": Code(checkpoint.dataset or dataset.uuid),
        "steps": f"{checkpoint.step:,} of {recipe.batch} triples each",
        "time": f"{duration(float(clock.seconds[-1]))} of training" if len(clock) else "",
        "time budget": recipe.budget or "none",
        "precision": recipe.precision,
        "on": f"{ranks}, device {recipe.device}, {hardware}",
        "versions": ", ".join(f"{name} {version}" for name, version in checkpoint.versions.items()),
    }
    return {name: fact for name, fact in facts.items() if fact != ""}


def _changed(recipe: TrainingRecipe) -> Table:
    """The fields that differ from the defaults, which are the paper's for DSFFNet."""
    usual = type(recipe)().model_copy(
        update={"network": type(recipe.network)()}
    )  # that as a whole nobody would train by
    here, there = flatten(recipe.model_dump(mode="json")), flatten(usual.model_dump(mode="json"))
    lines = [[key, value, there.get(key, "")] for key, value in here.items() if value != there.get(key, "")]
    caption = f"Training recipe: {len(lines)} of {len(here)} fields differ from the defaults"
    return Table([["field", "here", "default"], *lines], caption, "Defaults are those of the DSFFNet paper.")


def _results(rows: list[Row]) -> list[Block]:
    if not rows:
        return [Text("### Results\n\nNot evaluated yet: `dsffnet evaluate RUN --data X.zarr`.")]
    lines = [line for line in summary(rows).lines if line[1] not in CONTROLS]
    return [Table(lines, "Results on new identities", "Lower is better; definitions stand by the main table.")]


def _worse_than_nothing(rows: list[Row]) -> str:
    """What the measurements themselves say of failures: where doing nothing would have scored better."""
    found = [
        f"*{method}* in {', '.join(worse)} ({kind} poses)"
        for method in NO_OPS
        for kind in POSE_TYPES
        if (worse := _worse_columns(rows, method, kind))
    ]
    return f"\n- Measured worse than doing nothing: than {'; than '.join(found)}." if found else ""


def _worse_columns(rows: list[Row], method: str, pose_type: str) -> list[str]:
    own = next(iter(methods_of(rows)), "")

    def mean(each: str, field: str) -> float:
        return mean_of(rows, method=each, pose_type=pose_type, field=field)

    return [
        column.heading.split(" x1e")[0] for column in COLUMNS if mean(own, column.field) > mean(method, column.field)
    ]


def _network_words(recipe: TrainingRecipe) -> str:
    options = recipe.network.model_dump(mode="json", exclude={"name"})
    words = [f"{key.replace('_', ' ')} {_joined(value)}" for key, value in options.items()]
    return f"{NETWORKS[recipe.network.name]}; {', '.join(words)}"


def _joined(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(value)
    return "-".join(map(str, value)) if isinstance(value, list) else str(value).lower()


def _network_limits(recipe: TrainingRecipe) -> str:
    kind = f"npt {recipe.network.variant}" if isinstance(recipe.network, NptRecipe) else recipe.network.name
    return NETWORK_LIMITS.get(kind, "")


def _parameter_count(recipe: TrainingRecipe) -> int:
    with torch.random.fork_rng(devices=[]):  # building draws weights, and whoever reports draws nothing
        return sum(parameter.numel() for parameter in network_from(recipe.network).parameters())


def _usage(home: Path) -> str:
    run, record = shown(home), read_record(home)
    model = (record and record.model) or MODEL
    return f"""\
# on the command line
dsffnet transfer --model {shlex.quote(run)} --source pose.obj --target person.glb --out posed.glb

# in Python
from pathlib import Path
from datagen.mesh.files import read_mesh_file, write_posed
from training.inference.transfer import PoseTransfer
source, target = read_mesh_file("pose.obj"), read_mesh_file("person.glb")
posed = PoseTransfer.from_run({json.dumps(run, ensure_ascii=False)})(source=source.mesh, target=target.mesh)
write_posed(target, posed.vertices, Path("posed.glb"))

# from the registry, where MLflow has it
import mlflow
model = mlflow.pyfunc.load_model("models:/{model}@{ALIAS}")
model.predict({{"source": source_vertices, "target": target_vertices, "target_faces": target_faces}})"""


CONTACT_SHEET = "generate/contact-sheet.png"


def dataset_card(dataset: Dataset, *, picture: Path | None = None) -> Section:
    """What a dataset holds, what it was made from and how to make it again, what it is for, and where it ends.

    ``picture``: its contact sheet; by default the one that a workflow leaves beside the dataset, where it is there.
    """
    name, recipe = name_of(dataset), dataset.recipe
    sheet = picture or Path(dataset.url).parent / CONTACT_SHEET
    texts = family_texts(recipe.body)
    limits = DATASET_LIMITS.format(
        people="; ".join(text.people for text in texts),
        unlike="; ".join(text.unlike for text in texts),
        poses=POSES[recipe.poses.distribution.name],
    )
    body: list[Block] = [Facts(_dataset_facts(dataset))]
    if sheet.is_file():
        body.append(Picture(sheet, "Some identities (lines) in some poses (columns), both spread over the whole grid."))
    body += [
        _assets(dataset, [text.source for text in texts]),
        Text(f"### Intended use\n\n{DATASET_USE}\n\n### Limits\n\n{limits}\n\n### To make it again"),
        Code(f"dsffnet generate --recipe {shlex.quote(name)} --out AGAIN.zarr\ndsffnet verify AGAIN.zarr"),
        Code(as_yaml({"data": recipe.identifying()}), folded="Its recipe (paths of asset files left out)"),
    ]
    return Section("Dataset card", tuple(body))


def _dataset_facts(dataset: Dataset) -> dict[str, str | int | float | Code]:
    recipe, found = dataset.recipe, describe(dataset.url)
    faces = [len(dataset.faces(identity)) for identity in range(dataset.grid.identity_count)]
    options = recipe.poses.distribution.model_dump(mode="json", exclude={"name", "path", "degrees"})
    words = ", ".join(f"{key} {value}" for key, value in options.items() if value not in ([], ""))
    poses = f"{recipe.poses.distribution.name} ({words})" if words else recipe.poses.distribution.name
    joints = len(dataset.attributes["joints"])
    seeds = f"identities {recipe.identities.seed}, poses {recipe.poses.seed}, triples {recipe.triples.seed}"
    facts: dict[str, str | int | float | Code] = {
        "name": name_of(dataset),
        "uuid": Code(dataset.uuid),
        "body": found["body"],
        "vertices": span(vertex_counts(dataset)),
        "faces": span(faces),
        "identities": found["identities"],
        "poses": f"{len(dataset.grid.poses('seen')):,} seen, {len(dataset.grid.poses('unseen')):,} unseen",
        "appended": found.get("appended", ""),
        "pose distribution": f"{poses}; {joints} joints" if joints else poses,
        "seeds": seeds,
        "evaluation triples": found["evaluation triples"],
        "meshes": f"{dataset.attributes['statistics']['meshes']:,}",
        "size": f"{dataset.attributes['statistics']['bytes'] / 1e6:,.1f} MB on the disk",
        "extent": found["extent"],
        "units and frame": f"{dataset.attributes['units']}; {dataset.attributes['frame']}",
        "made with": found["packages"],
        "made by commit": Code(found["git commit"]),
        "sha256 of the recipe": Code(found["recipe sha256"]),
        "sha256 of the manifest": Code(dataset.attributes["manifest_sha256"]),
    }
    return {name: fact for name, fact in facts.items() if fact != ""}


def _assets(dataset: Dataset, sources: list[str]) -> Table:
    assets = dataset.attributes["body"]["assets"]
    lines = [[asset["name"], asset["licence"], asset["version"]] for asset in assets]
    notes = f"Where bodies come from: {'; '.join(sources)}."
    return Table([["made from", "licence", "version or sha256"], *lines], "Assets", notes)
