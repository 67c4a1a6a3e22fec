"""What a person looks at after an evaluation: figure of examples, GLB files and the HTML viewer."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import nn

from datagen.grid import PoseType
from datagen.mesh.files import save_mesh
from datagen.mesh.geometry import Mesh, bounding_box
from datagen.store import Dataset
from training.data.batch import read_batch
from training.evaluation.evaluate import POSE_TYPES, Row, evaluation_list
from training.inference.mesh_reading import takes_surfaces
from training.inference.predict import predict
from training.objectives import PMD_UNIT
from training.recipes.training import EvaluationRecipe
from training.viz.comparison_figure import comparison_figure
from training.viz.transfer_example import Comparison
from training.viz.viewer import write_viewer


def comparisons_of(
    dataset: Dataset, networks: Mapping[str, nn.Module], recipe: EvaluationRecipe, rows: Sequence[Row]
) -> list[Comparison]:
    """The first few triples of each evaluation list (not chosen by result) by each network, in metres.

    Parameters
    ----------
    dataset
        Of which the fixed lists of evaluation triples are used.
    networks
        Name of each method -> its network.
    recipe
        ``examples`` says how many triples of each pose type.
    rows
        The numbers under the pictures; a method without a row for a triple has none.
    """
    numbers = {(row.method, row.pose_type, row.triple): row for row in rows}
    return [one for pose_type in POSE_TYPES for one in _compared(dataset, networks, recipe, pose_type, numbers)]


def draw_comparisons(comparisons: Sequence[Comparison], folder: Path, *, title: str) -> None:
    """Write figures/examples.png, viewer.html, and meshes/NN-ROLE.glb of each; an output is NN-output-METHOD.glb.

    Of a single method it is NN-output.glb.
    """
    comparison_figure(comparisons, folder / "figures" / "examples.png")
    write_viewer(comparisons, folder / "viewer.html", title=title)
    for number, comparison in enumerate(comparisons):
        for name, mesh in comparison.meshes().items():
            role = "output" if name.startswith("output ") and len(comparison.outputs) == 1 else _file_name(name)
            save_mesh(Mesh(mesh.vertices, mesh.faces), folder / "meshes" / f"{number:02d}-{role}.glb")


_Numbers = Mapping[tuple[str, str, int], Row]


def _compared(
    dataset: Dataset,
    networks: Mapping[str, nn.Module],
    recipe: EvaluationRecipe,
    pose_type: PoseType,
    numbers: _Numbers,
) -> list[Comparison]:
    triples = evaluation_list(dataset, recipe, pose_type)[: recipe.examples]
    if not len(triples):
        return []
    told = any(map(takes_surfaces, networks.values()))
    batch = read_batch(dataset, triples, padded=True, surfaces=told)
    outputs = {name: predict(network, batch).double().cpu().numpy() for name, network in networks.items()}
    found = []
    for place, triple in enumerate(triples.tolist()):
        words = {
            name: _words(numbers[name, pose_type, place]) for name in networks if (name, pose_type, place) in numbers
        }
        shown = {name: output[place] for name, output in outputs.items()}
        found.append(_comparison(dataset, pose_type, triple, shown, words))
    return found


def _comparison(
    dataset: Dataset,
    pose_type: PoseType,
    triple: list[int],
    outputs: Mapping[str, NDArray[np.float64]],
    metrics: Mapping[str, str],
) -> Comparison:
    source_identity, source_pose, target_identity, target_pose = triple
    faces = dataset.faces(target_identity)
    truth = dataset.vertices(target_identity, source_pose).astype(np.float64)
    box = bounding_box(truth)
    return Comparison(
        title=f"{pose_type} pose {source_pose}, from identity {source_identity} to new identity {target_identity}",
        source=Mesh(dataset.vertices(source_identity, source_pose), dataset.faces(source_identity)),
        target=Mesh(dataset.vertices(target_identity, target_pose), faces),
        outputs={name: Mesh(box.restore(output[: len(truth)]), faces) for name, output in outputs.items()},
        truth=Mesh(truth, faces),
        metrics=metrics,
    )


def _words(row: Row) -> str:
    return f"PMD {row.pmd / PMD_UNIT:.1f}e-4, {row.millimetres:.0f} mm"


def _file_name(name: str) -> str:
    """A name for a file: what not every file system takes becomes a hyphen."""
    return re.sub(r"[^A-Za-z0-9._]+", "-", name).strip("-.")
