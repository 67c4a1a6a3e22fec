"""Evaluation: rows, tables, transfer."""

from pathlib import Path

import numpy as np
import pytest
import torch

from datagen.errors import MeshError
from datagen.generate import generate, inline
from datagen.mesh import Mesh, bounding_box, edges_of
from datagen.store import open_dataset
from tests.support.mixed import mixed_dataset
from tests.support.recipes import tiny_training
from training.batches import read_batch
from training.checkpoint import CheckpointError, require_checkpoint
from training.evaluation import NO_OPS, Row, evaluate, measure_chunk, read_rows, write_rows
from training.inference import load_trained, predict
from training.metrics import edge_length_ratio_error, point_mesh_distance
from training.recipe import EvaluationRecipe
from training.showcase import examples_of
from training.tables import markdown, mean_of, methods_of, report, summary
from training.trainer import train
from training.transfer import PoseTransfer

RECIPE = EvaluationRecipe(emd_points=16, chunk=3)


@pytest.fixture
def run(dataset: str, tmp_path: Path) -> Path:
    train(tiny_training(), data=dataset, run=tmp_path / "run")
    return tmp_path / "run"


def test_rows_are_those_of_the_fixed_list_and_no_ops_score_what_they_must(dataset: str, run: Path) -> None:
    opened = open_dataset(dataset)
    rows = evaluate(run, dataset, RECIPE, tasks=inline)
    assert len(rows) == 5 * 2 * 3 and methods_of(rows) == ["DSFFNet", *NO_OPS]
    listed = opened.evaluation_triples("unseen").tolist()

    def unit(identity: int, pose: int) -> np.ndarray:
        vertices = opened.vertices(identity, pose).astype(np.float64)
        return bounding_box(vertices).normalise(vertices)

    for row in rows:
        if row.method == "target unchanged" and row.pose_type == "unseen":
            source, source_pose, target, target_pose = listed[row.triple]
            assert (row.source_identity, row.target_identity) == (source, target)
            truth, output = unit(target, source_pose), unit(target, target_pose)
            assert row.pmd == pytest.approx(((output - truth) ** 2).mean(), rel=1e-4)
            half = bounding_box(opened.vertices(target, source_pose)).half
            error = np.linalg.norm(output - truth, axis=1).mean() * half * 1000
            assert row.millimetres == pytest.approx(error, rel=1e-4)
            assert row.earth_mover <= np.sqrt(3 * row.pmd) * 2 and row.chamfer <= 6 * row.pmd


def test_any_cutting_into_tasks_gives_the_same_rows(dataset: str, run: Path) -> None:
    whole = evaluate(run, dataset, RECIPE.model_copy(update={"chunk": 100}), tasks=inline)
    reversed_tasks = lambda task, arguments: iter([task(*each) for each in reversed(arguments)])  # noqa: E731
    pieces = evaluate(run, dataset, RECIPE.model_copy(update={"chunk": 1}), tasks=reversed_tasks)
    assert [(r.method, r.pose_type, r.triple) for r in whole] == [(r.method, r.pose_type, r.triple) for r in pieces]
    assert [r.pmd for r in whole] == pytest.approx([r.pmd for r in pieces], rel=1e-4)


def test_meshes_of_other_counts_are_each_measured_over_their_own_vertices(tmp_path: Path) -> None:
    data = generate(mixed_dataset(), str(tmp_path / "mixed.zarr"))
    train(tiny_training(steps=2), data=data.url, run=tmp_path / "run")
    rows = evaluate(tmp_path / "run", data.url, RECIPE, tasks=inline)
    assert methods_of(rows) == ["DSFFNet", NO_OPS[0]], "a source of another count can stand for no output"
    assert len({data.vertex_count(row.target_identity) for row in rows}) > 1
    network = load_trained(tmp_path / "run")[0]
    for row in rows:
        alone = np.array([[row.source_identity, row.source_pose, row.target_identity, row.target_pose]])
        batch = read_batch(data, alone)
        output = batch.target if row.method == NO_OPS[0] else predict(network, batch)
        edges = torch.from_numpy(edges_of(data.faces(row.target_identity)))
        assert row.pmd == pytest.approx(float(point_mesh_distance(output, batch.truth)), rel=1e-4)
        assert row.edge_ratio == pytest.approx(float(edge_length_ratio_error(output, batch.truth, edges)), rel=1e-4)
    examples = examples_of(data, network, RECIPE, rows)
    assert all(example.output.vertices.shape == example.truth.vertices.shape for example in examples)


def test_rows_survive_csv(dataset: str, run: Path, tmp_path: Path) -> None:
    rows = measure_chunk(str(require_checkpoint(run).path), dataset, RECIPE, "DSFFNet", "seen", 0)
    write_rows(rows, tmp_path / "rows.csv")
    assert read_rows(tmp_path / "rows.csv") == rows


def row(method: str, pose_type: str, triple: int, pmd: float) -> Row:
    return Row(method, pose_type, triple, 0, 0, 1, 1, pmd, pmd, 0.1, 0.2, 3.0, 0.04, 5.0)


def test_the_table_means_what_it_says() -> None:
    rows = [row("DSFFNet", "seen", 0, 1e-4), row("DSFFNet", "seen", 1, 3e-4), row("target unchanged", "seen", 0, 5e-2)]
    assert mean_of(rows, method="DSFFNet", pose_type="seen", field="pmd") == pytest.approx(2e-4)
    lines = summary(rows)
    assert lines[1] == ["seen", "DSFFNet", "2.00", "2.00", "1000.00", "200.00", "3.0", "0.040", "5.0"]
    assert [line[1] for line in lines[1:]] == ["DSFFNet", "target unchanged"]
    text = report(rows, title="T", about="A.", emd_points=64)
    assert "2 with seen poses" in text and "assignment (exact) of 64 vertices" in text
    widths = {len(line) for line in markdown(lines).splitlines()}
    assert len(widths) == 1, "columns line up"


def test_a_run_without_weights(dataset: str, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="has no usable checkpoint"):
        evaluate(tmp_path / "nothing", dataset, RECIPE, tasks=inline)


class TestTransfer:
    """Mesh in, mesh out."""

    def test_target_keeps_faces_order_place_and_size(self, dataset: str, run: Path) -> None:
        opened, transfer = open_dataset(dataset), PoseTransfer.from_run(run)
        source = Mesh(opened.vertices(0, 1), opened.faces(0))
        target = Mesh(opened.vertices(1, 2).astype(float), opened.faces(1))
        posed = transfer(source=source, target=target)
        assert np.array_equal(posed.faces, target.faces) and posed.vertices.shape == target.vertices.shape
        moved = Mesh(target.vertices * 2.5 + 7, target.faces)
        again = transfer(source=source, target=moved)
        assert np.allclose(again.vertices, (posed.vertices - bounding_box(target.vertices).centre) * 2.5
                           + bounding_box(moved.vertices).centre, atol=1e-3)  # fmt: skip

    def test_source_may_have_other_vertices_and_stand_elsewhere(self, dataset: str, run: Path) -> None:
        opened, transfer = open_dataset(dataset), PoseTransfer.from_run(run)
        target = Mesh(opened.vertices(1, 2), opened.faces(1))
        source = opened.vertices(0, 1)
        posed = transfer(source=Mesh(source, opened.faces(0)), target=target)
        doubled = Mesh(np.concatenate([source, source]) * 3 - 1, opened.faces(0))
        assert np.allclose(transfer(source=doubled, target=target).vertices, posed.vertices, atol=1e-4)

    def test_permuting_the_target_permutes_the_output(self, dataset: str, run: Path) -> None:
        opened, transfer = open_dataset(dataset), PoseTransfer.from_run(run)
        source, target = (opened.vertices(i, i).astype(float) for i in (0, 1))
        order = np.random.default_rng(0).permutation(len(target))
        assert np.allclose(
            transfer.vertices(source, target[order]), transfer.vertices(source, target)[order], atol=1e-5
        )

    def test_a_perfect_network_restores_the_right_size(self) -> None:
        """With a network that returns the target itself, the output is the target where it was."""

        class Identity(torch.nn.Module):
            def forward(self, *, source: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
                return target

        rng = np.random.default_rng(1)
        target = Mesh(rng.normal(size=(30, 3)) * 4 + 2, rng.integers(0, 30, (40, 3)))
        posed = PoseTransfer(Identity())(source=Mesh(rng.normal(size=(9, 3)), np.array([[0, 1, 2]])), target=target)
        assert np.allclose(posed.vertices, target.vertices, atol=1e-5)

    @pytest.mark.parametrize("bad", [np.full((3, 3), np.nan), np.zeros((3, 3)), np.zeros((0, 3))])
    def test_unusable_meshes_are_refused_by_name(self, dataset: str, run: Path, bad: np.ndarray) -> None:
        opened = open_dataset(dataset)
        good = Mesh(opened.vertices(0, 0), opened.faces(0))
        with pytest.raises(MeshError, match="source"):
            PoseTransfer.from_run(run)(source=Mesh(bad, np.array([[0, 1, 2]])), target=good)
