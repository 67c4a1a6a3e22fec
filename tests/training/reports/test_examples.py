"""What is shown of an evaluation: its first triples, by every method, in metres, with the numbers of the table."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from datagen.generate import generate
from datagen.mesh.files import load_mesh
from datagen.mesh.geometry import bounding_box
from datagen.store import Dataset, open_dataset
from tests.support.recipes import mixed_dataset, tiny_training
from training.evaluation.evaluate import POSE_TYPES, Row
from training.inference.predict import network_from
from training.recipes.training import EvaluationRecipe
from training.reports.examples import comparisons_of, draw_comparisons
from training.viz.transfer_example import Comparison

RECIPE = EvaluationRecipe(emd_points=8, examples=2)


class Unchanged(nn.Module):
    """The no-op: the target, a little larger."""

    def __init__(self, factor: float = 1.0) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(factor))

    def forward(self, *, source: Tensor, target: Tensor) -> Tensor:
        return self.factor * target


def rows_of(dataset: Dataset, method: str, pmd: float) -> list[Row]:
    return [
        Row(method, kind, place, *map(int, triple), pmd, pmd, 0.1, 0.2, 12.0, 0.3, 4.0, pmd)
        for kind in POSE_TYPES
        for place, triple in enumerate(dataset.evaluation_triples(kind))
    ]


def shown(dataset: Dataset, **factors: float) -> list[Comparison]:
    rows = [row for n, name in enumerate(factors, start=1) for row in rows_of(dataset, name, 0.001 * n)]
    return comparisons_of(dataset, {name: Unchanged(factor) for name, factor in factors.items()}, RECIPE, rows)


def test_the_first_triples_of_each_list_are_compared_whatever_their_results(dataset: str) -> None:
    opened = open_dataset(dataset)
    found = shown(opened, ours=1.0, theirs=0.5)
    triples = [triple for kind in POSE_TYPES for triple in opened.evaluation_triples(kind)[:2].tolist()]
    assert len(found) == len(triples) == 4
    for one, (source, source_pose, target, target_pose) in zip(found, triples, strict=True):
        assert (one.source.vertices == opened.vertices(source, source_pose)).all()
        assert (one.target.vertices == opened.vertices(target, target_pose)).all()
        assert one.truth is not None and (one.truth.vertices == opened.vertices(target, source_pose)).all()
        assert dict(one.metrics) == {"ours": "PMD 10.0e-4, 12 mm", "theirs": "PMD 20.0e-4, 12 mm"}


def test_outputs_are_in_metres_in_the_box_of_the_truth(dataset: str) -> None:
    one = shown(open_dataset(dataset), ours=1.0, theirs=0.5)[0]
    assert one.truth is not None
    sizes = [np.ptp(mesh.vertices, axis=0).max() for mesh in (one.truth, *one.outputs.values())]
    assert sizes[1] == pytest.approx(sizes[0], rel=1e-5) and sizes[2] == pytest.approx(sizes[0] / 2, rel=1e-5)


def test_each_output_is_that_of_its_own_triple(dataset: str) -> None:
    for one in shown(open_dataset(dataset), ours=1.0):
        assert one.truth is not None
        inside = [bounding_box(np.asarray(mesh.vertices)).normalise(mesh.vertices) for mesh in (one.target, one.truth)]
        output = bounding_box(np.asarray(one.truth.vertices)).normalise(one.outputs["ours"].vertices)
        assert output == pytest.approx(inside[0], abs=1e-5) and not np.allclose(output, inside[1], atol=1e-2)


def test_a_method_without_rows_has_a_picture_and_no_numbers(dataset: str) -> None:
    opened = open_dataset(dataset)
    (one, *_) = comparisons_of(opened, {"new": Unchanged()}, RECIPE, [])
    assert set(one.outputs) == {"new"} and one.metrics == {}


def test_meshes_of_different_vertex_counts_are_compared(tmp_path: Path) -> None:
    opened = generate(mixed_dataset(), str(tmp_path / "mixed.zarr"))
    network = network_from(tiny_training().network).eval()
    for one in comparisons_of(opened, {"DSFFNet": network}, RECIPE, rows_of(opened, "DSFFNet", 0.001)):
        assert one.truth is not None
        assert one.outputs["DSFFNet"].vertices.shape == one.truth.vertices.shape
        assert np.isfinite(one.outputs["DSFFNet"].vertices).all()


def test_figure_viewer_and_meshes_of_every_method_are_written(dataset: str, tmp_path: Path) -> None:
    found = shown(open_dataset(dataset), **{"DSFFNet": 1.0, "w/o L_edge": 0.5})[:2]
    draw_comparisons(found, tmp_path, title="legs")
    assert (tmp_path / "figures" / "examples.png").stat().st_size > 10_000 and (tmp_path / "viewer.html").is_file()
    names = [f"{n:02d}-{role}.glb" for n in (0, 1) for role in ("output-DSFFNet", "output-w-o-L_edge")]
    assert set(names) < {path.name for path in (tmp_path / "meshes").iterdir()}
    assert len(list((tmp_path / "meshes").iterdir())) == 10
    assert load_mesh(tmp_path / "meshes" / names[1]).vertices == pytest.approx(found[0].outputs["w/o L_edge"].vertices)


def test_the_output_of_a_single_method_is_called_output(dataset: str, tmp_path: Path) -> None:
    opened = open_dataset(dataset)
    draw_comparisons(
        comparisons_of(opened, {"mine": Unchanged()}, RECIPE, rows_of(opened, "mine", 0.1))[:1], tmp_path, title="legs"
    )
    names = sorted(path.name for path in (tmp_path / "meshes").iterdir())
    assert names == [f"00-{role}.glb" for role in ("output", "source", "target", "truth")]
