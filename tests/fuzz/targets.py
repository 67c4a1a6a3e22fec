"""Who reads what: each target reads one kind of damaged tree by a public function or a command, as people do.

A target returns a digest of what it read where that can be told from another content, else None.
"""

import hashlib
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from workflows.cli.main import main

Read = Callable[[Path], str | None]
"""Reads the tree at a path; the folder that it lies in is the current one, and what is written goes there."""


@dataclass(frozen=True)
class Target:
    """One way of reading.

    ``is_quick``: cheap enough for the default suite; ``needs``: specimens beside the damaged one; ``falls_to``: a
    pattern of what may be read in the place of a damaged tree.
    """

    name: str
    read: Read
    is_quick: bool = True
    needs: tuple[str, ...] = ()
    falls_to: str = "nothing"


@dataclass(frozen=True)
class Family:
    """What is damaged: the folder of specimens it comes with, the path in it, and who reads it.

    ``trees`` is a pattern in that folder, one of whose paths is damaged in a case; the rest of the folder stays.
    ``named``: files in it that a person names, which may be links as that person likes.
    """

    specimen: str
    trees: str
    targets: tuple[Target, ...]
    named: str = ""


def _command(*words: str) -> Read:
    """A target that types a command; {} stands for the damaged tree."""

    def read(tree: Path) -> None:
        main([word.replace("{}", str(tree)) for word in words])

    return read


def _digest(parts: Iterable[object]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return digest.hexdigest()


def _whole_dataset(tree: Path) -> str:
    from datagen.store import open_dataset

    dataset = open_dataset(str(tree))
    parts: list[object] = [dataset.uuid, dataset.rotations()]
    for identity in range(dataset.grid.identity_count):
        parts += [dataset.faces(identity), dataset.parameters(identity), dataset.vertices(identity)]
    return _digest([*parts, *map(dataset.evaluation_triples, ("seen", "unseen"))])


def _some_meshes(tree: Path) -> None:
    """As training does: single meshes by range."""
    from datagen.store import open_dataset

    dataset = open_dataset(str(tree))
    for identity in (0, 4):
        dataset.vertices(identity, int(dataset.grid.poses_of(identity)[1]))


def _verified(tree: Path) -> str:
    main(["verify", str(tree)])
    return _whole_dataset(tree)


def _weights(tree: Path) -> str:
    from training.checkpoints.checkpoint import require_checkpoint

    return _digest(sorted((name, value.tolist()) for name, value in require_checkpoint(tree).weights().items()))


def _network_of_run(tree: Path) -> None:
    from training.inference.domain_check import seen_by
    from training.inference.predict import load_trained
    from workflows.pipeline.weights_argument import evaluated
    from workflows.studies.mesh_kinds import own_recipe

    for which in ("result", "best", 2):
        found = evaluated(tree, which)  # type: ignore[arg-type]
        load_trained(found.weights)
        seen_by(found.weights)
    own_recipe(tree)


def _resume(tree: Path) -> None:
    """Training resumes for two steps, on the dataset that it was trained on."""
    from tests.support.recipes import tiny_training
    from training.engine.trainer import train

    train(tiny_training(steps=4, checkpoint_every=2, evaluate_every=2, average=0.9), data="leg.zarr", run=tree)


def _state_of_run(tree: Path) -> None:
    from training.checkpoints.checkpoint import recipe_of, require_checkpoint

    checkpoint = require_checkpoint(tree)
    recipe_of(checkpoint)
    checkpoint.state()


def _learned(tree: Path) -> None:
    """What figures and reports read of a run."""
    from training.recipes.files import recipe_in
    from training.tracking.journal import read_journal

    read_journal(tree / "metrics.jsonl")
    recipe_in(tree / "recipe.yaml")


def _recipe_in(tree: Path) -> None:
    from training.recipes.files import recipe_in

    recipe_in(tree)


def _network(tree: Path) -> None:
    from training.inference.predict import load_trained

    load_trained(tree)


def _released(tree: Path) -> None:
    from training.networks.released_weights import load_released_npt

    load_released_npt(tree, variant="maxpool")


def _records(tree: Path) -> None:
    """As MLflow's mirror does, without a server."""
    from training.tracking.mirror_state import read_sent, unsent_artifacts, unsent_rows
    from training.tracking.record import find_records, read_record

    for folder in find_records(tree):
        record = read_record(folder)
        sent = read_sent(folder, "sqlite:///mlflow.db")
        list(unsent_rows(folder, sent.get("offsets", {}), values=900))
        list(unsent_artifacts(folder, record.artifacts if record else [], sent.get("artifacts", {})))


def _synced(tree: Path) -> None:
    main(["sync", str(tree), "--tracking-uri", f"sqlite:///{tree.parent / 'mlflow.db'}"])


def _stages(tree: Path) -> None:
    from workflows.pipeline.run_folder import SingleRunFolder
    from workflows.pipeline.stage import Stage, run_stage

    SingleRunFolder(tree).require_kind()
    stage = Stage("generate", depends_on="data", intact=lambda: True, work=lambda: None)
    run_stage(stage, out=tree, before=lambda: None)
    assert not run_stage(stage, out=tree, before=lambda: None), (
        "the mark of a stage that was finished is not read again"
    )


def _began_again(tree: Path) -> None:
    """The same command resumes a run's record, whatever it finds."""
    from training.tracking.record import begin_record, end_record, read_record, update_record

    begin_record(tree / "run", name="train", kind="train", parent=tree, parameters={})
    update_record(tree / "run", artifacts=["figures"])
    end_record(tree / "run", "FINISHED")
    assert read_record(tree / "run") is not None


def _kept_rows(tree: Path) -> None:
    from training.evaluation.results import read_piece

    read_piece(tree / "run" / "rows.csv", [("DSFFNet", "seen", 3)] * 3)


def _mesh(tree: Path) -> None:
    from datagen.mesh.files import read_mesh_file, write_posed

    file = _mesh_in(tree)
    read = read_mesh_file(file)
    for suffix in (".obj", ".glb", file.suffix):
        write_posed(read, read.mesh.vertices * 2, Path("out") / suffix[1:] / f"posed{suffix}")


def _plain_mesh(tree: Path) -> None:
    from datagen.mesh.files import load_mesh

    load_mesh(tree)


def _mesh_in(tree: Path) -> Path:
    return tree / f"mesh.{tree.name.split()[0]}"


def _sequence(tree: Path) -> None:
    from datagen.mesh.files import read_mesh_file
    from datagen.mesh.sequences import frames_of

    for frame in frames_of(tree):
        read_mesh_file(frame)


def _character(tree: Path) -> None:
    from datagen.characters.character import load_character

    file = tree / tree.name.replace(" ", ".")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        character = load_character(file)
        for name in list(character.clips)[:3]:
            character.pose(name, 0.4)


def _poses(tree: Path) -> None:
    from datagen.poses.pose_files import read_pose_file

    read_pose_file(tree)


def _motion(tree: Path) -> None:
    from datagen.poses.amass_files import find_motions, read_frames

    for motion in find_motions(str(tree)):
        read_frames(motion)


def _model(tree: Path) -> None:
    from datagen.bodies.smpl_family.model_file import read_model

    read_model(tree)


_TRANSFER = ("transfer", "--model", "{}", "--source", "pose.obj", "--target", "person.obj", "--out", "out/posed.obj")

FAMILIES: dict[str, Family] = {
    "dataset": Family(
        "dataset",
        "leg.zarr",
        (
            Target("read", _whole_dataset),
            Target("some meshes", _some_meshes),
            Target("verify", _verified),
            Target("inspect", _command("inspect", "{}", "--picture", "none")),
            Target("repair", _command("verify", "{}", "--repair"), is_quick=False),
            Target("picture", _command("inspect", "{}", "--picture", "out.png"), is_quick=False),
            Target("export", _command("export", "{}", "--layout", "obj", "--out", "out"), is_quick=False),
            Target("again", _command("generate", "--recipe", "{}", "--local", "--out", "again.zarr"), is_quick=False),
            Target("append", _command("append", "{}", "--unseen-poses", "6", "--local"), is_quick=False),
            Target("recipe", _command("recipe", "--recipe", "{}")),
        ),
    ),
    "run": Family(
        "run",
        "run",
        (
            Target("weights", _weights, falls_to="checkpoints/step-*"),
            Target("network", _network_of_run),
            Target("state", _state_of_run),
            Target("journal", _learned),
            Target("transfer", _command(*_TRANSFER), is_quick=False),
        ),
    ),
    "resume": Family("run", "half", (Target("resume", _resume, is_quick=False, needs=("dataset",)),)),
    "weights": Family("weights", "weights", (Target("network", _network), Target("weights", _weights))),
    "weights-file": Family(
        "weights",
        "weights/more/alone.safetensors",
        (Target("network", _network), Target("weights", _weights)),
    ),
    "released": Family("weights", "weights/npt.pth", (Target("released", _released),)),
    "workflow": Family(
        "workflow",
        "workflow",
        (
            Target("records", _records),
            Target("stages", _stages),
            Target("began again", _began_again),
            Target("rows", _kept_rows),
            Target("sync", _synced, is_quick=False, needs=("server",)),
        ),
    ),
    "recipe": Family(
        "recipe",
        "*.yaml",
        (Target("recipe", _command("recipe", "--recipe", "{}")), Target("training", _recipe_in)),
    ),
    "mesh": Family("mesh", "*", (Target("written again", _mesh), Target("sequence", _sequence)), named="mesh.*"),
    "plain-mesh": Family("plain", "mesh.*", (Target("plain", _plain_mesh),)),
    "character": Family("character", "*", (Target("character", _character),), named="rig.*"),
    "poses": Family("poses", "poses.npz", (Target("poses", _poses),)),
    "motion": Family("poses", "motion.npz", (Target("motion", _motion),)),
    "model": Family(
        "model",
        "model.*",
        (Target("model", _model), Target("convert", _command("convert-body", "{}", "--out", "out.npz"))),
    ),
}
