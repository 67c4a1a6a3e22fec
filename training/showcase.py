"""What a person looks at after an evaluation: example figure, training curve, GLB files and the HTML viewer."""

from pathlib import Path

import numpy as np
from torch import nn

from datagen.mesh import Mesh, bounding_box, save_mesh
from datagen.store import Dataset
from training.batches import read_batch
from training.curves import training_curve
from training.evaluation import POSE_TYPES, Row, evaluation_list
from training.figures import TransferExample, transfer_figure
from training.inference import predict
from training.journal import read_journal
from training.recipe import EvaluationRecipe
from training.viewer import write_viewer


def examples_of(
    dataset: Dataset, network: nn.Module, recipe: EvaluationRecipe, rows: list[Row]
) -> list[TransferExample]:
    """The first few triples of each evaluation list (not chosen by result), in metres, with their numbers."""
    found = []
    for pose_type in POSE_TYPES:
        triples = evaluation_list(dataset, recipe, pose_type)[: recipe.examples]
        if not len(triples):
            continue
        outputs = predict(network, read_batch(dataset, triples, padded=True)).double().numpy()
        for place, (triple, output) in enumerate(zip(triples, outputs, strict=True)):
            found.append(_example(dataset, pose_type, place, [int(number) for number in triple], output, rows))
    return found


def _example(
    dataset: Dataset, pose_type: str, place: int, triple: list[int], output: np.ndarray, rows: list[Row]
) -> TransferExample:
    source_identity, source_pose, target_identity, target_pose = triple
    faces = dataset.faces(target_identity)
    truth = dataset.vertices(target_identity, source_pose).astype(np.float64)
    row = next(r for r in rows if (r.pose_type, r.triple) == (pose_type, place) and not r.method.endswith("unchanged"))
    return TransferExample(
        title=f"{pose_type} pose {source_pose}, from identity {source_identity} to new identity {target_identity}",
        source=Mesh(dataset.vertices(source_identity, source_pose), dataset.faces(source_identity)),
        target=Mesh(dataset.vertices(target_identity, target_pose), faces),
        output=Mesh(bounding_box(truth).restore(output[: len(truth)]), faces),
        truth=Mesh(truth, faces),
        metrics=f"PMD {row.pmd * 1e4:.1f}e-4, mean error {row.millimetres:.0f} mm",
    )


def draw_examples(examples: list[TransferExample], folder: Path, *, title: str) -> None:
    """Write figures/examples.png, viewer.html, and meshes/NN-ROLE.glb for each example."""
    transfer_figure(examples, folder / "figures" / "examples.png")
    write_viewer(examples, folder / "viewer.html", title=title)
    for number, example in enumerate(examples):
        for role in ("source", "target", "output", "truth"):
            mesh = getattr(example, role)
            save_mesh(Mesh(mesh.vertices, mesh.faces), folder / "meshes" / f"{number:02d}-{role}.glb")


def draw_training_curve(run: Path, path: Path, *, baselines: dict[str, float]) -> None:
    """Loss and evaluation PMD over the steps of a run; ``baselines`` are dashed lines."""
    training_curve(read_journal(run / "metrics.jsonl"), path, baselines=baselines)
