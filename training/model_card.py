"""The card of a trained model: what its weights are, how they came about, what they score, where they end."""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from datagen.store import Dataset
from training.card_texts import MODEL_LIMITS, MODEL_USE, NETWORK_LIMITS, NETWORKS, as_yaml, name_of, span, vertex_counts
from training.checkpoint import Checkpoint, require_checkpoint
from training.checkpoint_folder import AVERAGE, WEIGHTS, sha256_of
from training.earlier import recipe_of
from training.evaluation import NO_OPS, POSE_TYPES, Row
from training.inference import network_from
from training.journal import read_journal
from training.provenance import provenance_of
from training.recipe import NptRecipe, TrainingRecipe
from training.record import ALIAS, MODEL, flatten
from training.report_blocks import Block, Code, Facts, Section, Table, Text
from training.report_inline import plain
from training.report_links import shown
from training.report_origin import duration
from training.sweep_figures import run_curve
from training.tables import COLUMNS, mean_of, methods_of, summary


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
    limits = MODEL_LIMITS.format(vertices=span(vertex_counts(dataset, "training")), network=_network_limits(recipe))
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
    weights = checkpoint.path if checkpoint.path.is_file() else _weights_file(checkpoint.path)
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
    usual = type(recipe)(network=type(recipe.network)())
    here, there = flatten(recipe.model_dump(mode="json")), flatten(usual.model_dump(mode="json"))
    lines = [[key, value, there.get(key, "")] for key, value in here.items() if value != there.get(key, "")]
    caption = f"Training recipe: {len(lines)} of {len(here)} fields differ from the defaults"
    return Table([["field", "here", "default"], *lines], caption, "Defaults are those of the DSFFNet paper.")


def _results(rows: list[Row]) -> list[Block]:
    if not rows:
        return [Text("### Results\n\nNot evaluated yet: `dsffnet evaluate RUN --data X.zarr`.")]
    lines = [line for line in summary(rows) if line[1] not in NO_OPS]
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
    return [
        column.heading.split(" x1e")[0]
        for column in COLUMNS
        if _mean(rows, _own(rows), pose_type, column.field) > _mean(rows, method, pose_type, column.field)
    ]


def _own(rows: list[Row]) -> str:
    return next(iter(methods_of(rows)), "")


def _mean(rows: list[Row], method: str, pose_type: str, field: str) -> float:
    return mean_of(rows, method=method, pose_type=pose_type, field=field)


def _network_words(recipe: TrainingRecipe) -> str:
    options = recipe.network.model_dump(mode="json", exclude={"name"})
    words = [f"{key.replace('_', ' ')} {_joined(value)}" for key, value in options.items()]
    return f"{NETWORKS[recipe.network.name]}; {', '.join(words)}"


def _joined(value: Any) -> str:
    return "-".join(map(str, value)) if isinstance(value, list) else str(value).lower()


def _network_limits(recipe: TrainingRecipe) -> str:
    kind = f"npt {recipe.network.variant}" if isinstance(recipe.network, NptRecipe) else recipe.network.name
    return NETWORK_LIMITS.get(kind, "")


def _parameter_count(recipe: TrainingRecipe) -> int:
    with torch.random.fork_rng(devices=[]):  # building draws weights, and whoever reports draws nothing
        return sum(parameter.numel() for parameter in network_from(recipe.network).parameters())


def _weights_file(folder: Path) -> Path:
    return folder / (AVERAGE if (folder / AVERAGE).exists() else WEIGHTS)


def _usage(home: Path) -> str:
    run = shown(home)
    return f"""\
# on the command line
dsffnet transfer --model {shlex.quote(run)} --source pose.obj --target person.glb --out posed.glb

# in Python
from pathlib import Path
from datagen.mesh_files import read_mesh_file, write_posed
from training.transfer import PoseTransfer
source, target = read_mesh_file("pose.obj"), read_mesh_file("person.glb")
posed = PoseTransfer.from_run({json.dumps(run, ensure_ascii=False)})(source=source.mesh, target=target.mesh)
write_posed(target, posed.vertices, Path("posed.glb"))

# from the registry, where MLflow has it
import mlflow
model = mlflow.pyfunc.load_model("models:/{MODEL}@{ALIAS}")
model.predict({{"source": source_vertices, "target": target_vertices, "target_faces": target_faces}})"""
