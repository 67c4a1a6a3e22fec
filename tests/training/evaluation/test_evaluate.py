"""Evaluation (many methods, resumable), and transfer of single meshes."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datagen.common.errors import CheckpointError, EvaluationError, MeshError
from datagen.generate import generate, inline
from datagen.mesh.geometry import Mesh, bounding_box, edges_of
from datagen.store import Dataset, open_dataset
from tests.support.recipes import mixed_dataset, tiny_dataset, tiny_training
from training.checkpoints.checkpoint import export_weights, require_checkpoint
from training.data.batch import read_batch
from training.engine.trainer import train
from training.evaluation import evaluate as evaluation
from training.evaluation import measure as measuring
from training.evaluation.evaluate import NO_OPS, Method, Row, evaluate, measure_chunk, read_rows, triples_in, write_rows
from training.evaluation.measure import Contender
from training.evaluation.tables import methods_of
from training.inference.predict import load_trained, predict
from training.inference.transfer import PoseTransfer
from training.objectives.metrics import edge_length_ratio_error, point_mesh_distance
from training.recipes.networks import CoreNet3dRecipe, DsffnetRecipe, NetworkRecipe, NptRecipe
from training.recipes.training import EvaluationRecipe
from training.reports.examples import comparisons_of

RECIPE = EvaluationRecipe(emd_points=16, chunk=3)


def ours(weights: Path) -> Method:
    return Method("DSFFNet", str(weights))


@pytest.fixture(scope="module")
def run(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of eight steps, read only."""
    folder = tmp_path_factory.mktemp("run")
    train(tiny_training(), data=str(_pristine), run=folder)
    return folder


def test_rows_are_those_of_the_fixed_list_and_no_ops_score_what_they_must(dataset: str, run: Path) -> None:
    opened = open_dataset(dataset)
    rows = evaluate([ours(run)], dataset, RECIPE, tasks=inline)
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
    whole = evaluate([ours(run)], dataset, RECIPE.model_copy(update={"chunk": 100}), tasks=inline)
    reversed_tasks = lambda task, arguments: iter([task(*each) for each in reversed(arguments)])  # noqa: E731
    pieces = evaluate([ours(run)], dataset, RECIPE.model_copy(update={"chunk": 1}), tasks=reversed_tasks)
    assert [(r.method, r.pose_type, r.triple) for r in whole] == [(r.method, r.pose_type, r.triple) for r in pieces]
    assert [r.pmd for r in whole] == pytest.approx([r.pmd for r in pieces], rel=1e-4)


def test_meshes_of_other_counts_are_each_measured_over_their_own_vertices(tmp_path: Path) -> None:
    data = generate(mixed_dataset(), str(tmp_path / "mixed.zarr"))
    train(tiny_training(steps=2), data=data.url, run=tmp_path / "run")
    rows = evaluate([ours(tmp_path / "run")], data.url, RECIPE, tasks=inline)
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
    examples = comparisons_of(data, {"DSFFNet": network}, RECIPE, rows)
    assert all(
        mesh.vertices.shape == one.truth.vertices.shape
        for one in examples
        for mesh in one.outputs.values()
        if one.truth
    )


def test_rows_survive_csv(dataset: str, run: Path, tmp_path: Path) -> None:
    contenders = [Contender('DSFFNet, 3 "steps"', str(require_checkpoint(run).path)), Contender(NO_OPS[0], "")]
    rows = measure_chunk(contenders, dataset, RECIPE, "seen", 0)
    write_rows(rows, tmp_path / "rows.csv")
    assert read_rows(tmp_path / "rows.csv") == rows


class Tasks:
    """Runs tasks here, counts them, and may fail after some."""

    def __init__(self, fail_after: int | None = None) -> None:
        self.measured: list[tuple[list[str], str, int]] = []
        self._fail_after = fail_after

    def __call__(self, task: Callable[..., Any], arguments: list[tuple[Any, ...]]) -> Iterator[Any]:
        for contenders, *rest in arguments:
            if len(self.measured) == self._fail_after:
                raise KeyboardInterrupt
            self.measured.append(([contender.name for contender in contenders], rest[2], rest[3]))
            yield task(contenders, *rest)


@pytest.fixture(scope="module")
def other(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of NPT, read only."""
    folder, network = tmp_path_factory.mktemp("other"), {"name": "npt", "encoder_widths": (8, 8, 13)}
    train(tiny_training(network=network, steps=2), data=str(_pristine), run=folder)
    return folder


def test_all_methods_are_measured_on_the_same_triples_as_each_would_be_alone(
    dataset: str, run: Path, other: Path
) -> None:
    tasks = Tasks()
    together = evaluate([ours(run), Method("NPT", str(other))], dataset, RECIPE, tasks=tasks)
    assert methods_of(together) == ["DSFFNet", "NPT", *NO_OPS]
    assert [(pose_type, start) for _, pose_type, start in tasks.measured] == [
        (t, s) for t in ("seen", "unseen") for s in (0, 3)
    ]
    alone = [evaluate([method], dataset, RECIPE, tasks=inline) for method in (ours(run), Method("NPT", str(other)))]
    assert together == sorted({*alone[0], *alone[1]})
    of = [[as_key(row) for row in together if row.method == method] for method in methods_of(together)]
    assert len(of[0]) == 10 and all(keys == of[0] for keys in of)


def as_key(row: Row) -> tuple[Any, ...]:
    return row.pose_type, row.triple, row.source_identity, row.source_pose, row.target_identity, row.target_pose


def test_after_an_interruption_only_what_is_missing_is_measured(dataset: str, run: Path, tmp_path: Path) -> None:
    keep, first, seen = tmp_path / "kept", Tasks(fail_after=2), []

    def progress(chunks: Iterable[list[Row]], total: int, done: int) -> Iterator[list[Row]]:
        seen.append((total, done))
        for rows in chunks:
            seen.append((triples_in(rows), len(rows)))
            yield rows

    with pytest.raises(KeyboardInterrupt):
        evaluate([ours(run)], dataset, RECIPE, tasks=first, keep=keep, progress=progress)
    assert seen == [(10, 0), (3, 9), (2, 6)]
    seen.clear()
    second = Tasks()
    rows = evaluate([ours(run)], dataset, RECIPE, tasks=second, keep=keep, progress=progress)
    assert [start for _, _, start in second.measured] == [0, 3] and seen == [(10, 5), (3, 9), (2, 6)]
    assert rows == evaluate([ours(run)], dataset, RECIPE, tasks=inline)
    third = Tasks()
    assert evaluate([ours(run)], dataset, RECIPE, tasks=third, keep=keep) == rows and third.measured == []


def test_a_method_that_is_added_is_measured_alone(dataset: str, run: Path, other: Path, tmp_path: Path) -> None:
    evaluate([ours(run)], dataset, RECIPE, tasks=inline, keep=tmp_path / "kept")
    tasks, both = Tasks(), [ours(run), Method("NPT", str(other))]
    rows = evaluate(both, dataset, RECIPE, tasks=tasks, keep=tmp_path / "kept")
    assert {tuple(names) for names, _, _ in tasks.measured} == {("NPT",)}
    assert rows == evaluate(both, dataset, RECIPE, tasks=inline)


@pytest.mark.parametrize("change", ["weights", "points", "seed", "dataset", "network", "damage", "cut"])
def test_kept_rows_of_anything_else_are_not_taken(
    dataset: str, run: Path, tmp_path: Path, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep, recipe, method = tmp_path / "kept", RECIPE, ours(run / "checkpoints" / "step-00000008")
    evaluate([method], dataset, recipe, tasks=inline, keep=keep)
    before, tasks = sorted(keep.iterdir()), Tasks()
    (keep / "notes.csv").write_text("a person's")
    if change == "weights":
        method = ours(run / "checkpoints" / "step-00000004")
    elif change in ("points", "seed"):
        recipe = RECIPE.model_copy(update={"emd_points": 8} if change == "points" else {"seed": 1})
    elif change == "dataset":
        monkeypatch.setattr(Dataset, "uuid", "another")
    elif change == "network":
        monkeypatch.setattr(
            evaluation, "recipe_of", lambda *_, **__: tiny_training(network={"encoder_widths": (9, 9, 9)})
        )
    else:
        path = next(path for path in before if "DSFFNet" in path.read_text())
        text = path.read_text()
        path.write_text(text[:-3].rsplit("\n", 1)[0] if change == "cut" else text.replace("seen", "s\0n", 1))
    evaluate([method], dataset, recipe, tasks=tasks, keep=keep)
    names = {name for names, _, _ in tasks.measured for name in names}
    assert "DSFFNet" in names and (change not in ("weights", "network", "damage", "cut") or names == {"DSFFNet"})
    assert len(tasks.measured) == (1 if change in ("damage", "cut") else 4)
    after = [path for path in sorted(keep.iterdir()) if path.name != "notes.csv"]
    assert (keep / "notes.csv").exists() and len(after) == len(before)
    assert (after == before) == (change in ("damage", "cut"))


def test_weights_written_to_the_same_place_are_loaded_anew(dataset: str, run: Path, tmp_path: Path) -> None:
    file, found = tmp_path / "exported", []
    for step in (4, 8):
        export_weights(require_checkpoint(run, step), file)
        found.append(evaluate([ours(file)], dataset, RECIPE, tasks=inline, keep=tmp_path / "kept")[0].pmd)
    expected = [evaluate([ours(run / f"checkpoints/step-0000000{n}")], dataset, RECIPE, tasks=inline) for n in (4, 8)]
    assert found == [rows[0].pmd for rows in expected] and found[0] != found[1]


def test_an_output_that_is_not_finite_is_nan_and_spoils_no_other(
    dataset: str, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Diverged(torch.nn.Module):
        def forward(self, *, source: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
            return target / 0

    monkeypatch.setattr(measuring, "_network", lambda *_: Diverged())
    rows = evaluate([ours(run)], dataset, RECIPE, tasks=inline)
    values = {row.method: (row.pmd, row.chamfer, row.earth_mover, row.edge_ratio, row.normal_degrees) for row in rows}
    assert np.isnan(values["DSFFNet"]).all() and np.isfinite(values[NO_OPS[0]]).all()


def test_methods_that_cannot_be_told_apart_are_refused(dataset: str, run: Path) -> None:
    for name in ("DSFFNet", NO_OPS[1]):
        methods = [ours(run), Method(name, str(run))]
        with pytest.raises(EvaluationError, match=f"two methods are called '{name}'"):
            evaluate(methods, dataset, RECIPE, tasks=inline)


def test_a_network_that_pairs_vertices_is_refused_where_counts_differ(tmp_path: Path, dataset: str) -> None:
    pairing = {"name": "npt", "variant": "origin", "encoder_widths": (8, 8, 13)}
    train(tiny_training(network=pairing, steps=2), data=dataset, run=tmp_path / "origin")
    methods, mixed = (
        [Method("NPT", str(tmp_path / "origin"))],
        generate(mixed_dataset(), str(tmp_path / "mixed.zarr")).url,
    )
    assert len(evaluate(methods, dataset, RECIPE, tasks=inline)) == 30
    pattern = r"NPT pairs .*'origin'\), but (un)?seen triple \d of .*mixed.zarr has a source of 3\d vertices .* of 3\d"
    with pytest.raises(EvaluationError, match=pattern):
        evaluate(methods, mixed, RECIPE, tasks=inline)


def test_data_without_triples_are_refused(tmp_path: Path, run: Path) -> None:
    data = generate(tiny_dataset(triples={"count": 0}), str(tmp_path / "none.zarr"))
    with pytest.raises(EvaluationError, match=r"none.zarr lists no evaluation triples.*data.triples.count=400"):
        evaluate([ours(run)], data.url, RECIPE, tasks=inline)


@pytest.mark.parametrize(
    ("network", "name"),
    [
        (DsffnetRecipe(), "DSFFNet"),
        (DsffnetRecipe(feature_fusion=False), "DSFFNet w/o FFAdaIN"),
        (DsffnetRecipe(target_side=False), "DSFFNet w/o side target"),
        (NptRecipe(), "NPT"),
        (NptRecipe(variant="origin"), "NPT origin"),
        (CoreNet3dRecipe(), "3D-CoreNet"),
    ],
)
def test_networks_have_the_names_of_the_paper(network: NetworkRecipe, name: str) -> None:
    assert network.title == name


def test_a_run_without_weights(dataset: str, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="has no usable checkpoint"):
        evaluate([ours(tmp_path / "nothing")], dataset, RECIPE, tasks=inline)


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
