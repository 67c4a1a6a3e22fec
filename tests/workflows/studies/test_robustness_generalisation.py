"""The two studies of trained weights as commands: files, resuming, refusals, recipes of the kinds."""

import argparse
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from datagen.common.errors import RecipeError, WorkflowError
from datagen.generate import generate
from datagen.recipe import AnnyBody, DatasetRecipe, NptPoses
from datagen.store import open_dataset
from tests.support.recipes import shards_of, tiny_dataset, tiny_training, vertices_of
from training.engine.trainer import train
from training.evaluation.generalisation import have_truth
from training.evaluation.results import read_csv
from training.evaluation.robustness import RobustnessRow
from training.tracking.record import begin_record, read_record
from workflows.cli.main import parsed
from workflows.pipeline.run_folder import EvaluationFolder
from workflows.studies.common import about_weights, folder_of, weights_of
from workflows.studies.generalisation import examples
from workflows.studies.mesh_kinds import (
    Sizes,
    animals_recipe,
    imported_kind,
    make_kinds,
    own_kind,
    own_recipe,
    people_recipe,
)


def study(*words: str) -> None:
    options = parsed(words)
    options.command(options)


@pytest.fixture
def run(dataset: str, tmp_path: Path) -> Path:
    train(tiny_training(), data=dataset, run=tmp_path / "run")
    return tmp_path / "run"


def test_robustness_writes_its_files_and_goes_on_from_them(
    dataset: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "study"
    words = [str(run), "--data", dataset, "--out", str(out), "--triples", "2", "--only", "noise"]
    study("robustness", *words)
    text = (out / "robustness.md").read_text()
    assert text in capsys.readouterr().out and "DSFFNet: step 8" in text and "| Noise" in text
    record = read_record(out)
    assert record is not None and record.status == "FINISHED" and "pmd/noise/DSFFNet" in record.metrics
    assert all((out / name).stat().st_size for name in record.artifacts) and len(record.artifacts) == 5
    monkeypatch.setattr(
        "workflows.studies.robustness.RobustnessStudy.draw", lambda *_: None
    )  # takes seconds, and is seen above
    before = (out / "rows.csv").read_text()
    study("robustness", *words, "shift")
    assert (out / "rows.csv").read_text().startswith(before), "what was measured is kept, more is added"
    assert {row.disturbance for row in read_csv(out / "rows.csv", RobustnessRow)} == {"", "noise", "shift"}
    study("robustness", *words[:5], "--triples", "1", "--only", "shift")
    assert {row.disturbance for row in read_csv(out / "rows.csv", RobustnessRow)} == {"", "shift"}, (
        "others were of other triples"
    )


def test_two_runs_of_one_network_are_told_apart_by_their_folders(
    dataset: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train(tiny_training(steps=4), data=dataset, run=tmp_path / "second")
    monkeypatch.setattr("workflows.studies.robustness.RobustnessStudy.draw", lambda *_: None)
    out = tmp_path / "both"
    study(
        "robustness",
        str(run),
        str(tmp_path / "second"),
        "--data",
        dataset,
        "--out",
        str(out),
        "--triples",
        "1",
        "--only",
        "scale",
    )
    names = {row.method for row in read_csv(out / "rows.csv", RobustnessRow)}
    assert names == {"target unchanged", f"DSFFNet {tmp_path.name}", "DSFFNet second"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--only", "dust"], "--only dust.*noise, patch"),
        (["--triples", "0"], "--triples 0: use 1 or more"),
        (["--example", "5"], "0 to 4"),
    ],
)
def test_impossible_wishes_are_refused(dataset: str, run: Path, tmp_path: Path, words: list[str], message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        study("robustness", str(run), "--data", dataset, "--out", str(tmp_path / "none"), *words)
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(("folder", "message"), [("run", "record of train"), ("rows", "rows of another study")])
def test_a_study_replaces_nothing_of_others(dataset: str, run: Path, tmp_path: Path, folder: str, message: str) -> None:
    (tmp_path / "rows").mkdir()
    (tmp_path / "rows" / "rows.csv").write_text("mine")
    begin_record(run, name="train", kind="train", parent=None, parameters={})
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(RecipeError, match=message):
        study("robustness", str(run), "--data", dataset, "--out", str(tmp_path / folder), "--triples", "1")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_run_named_twice_and_a_folder_in_a_dataset_are_refused(dataset: str, run: Path, tmp_path: Path) -> None:
    checkpoint = run / "checkpoints" / "step-00000008"
    with pytest.raises(RecipeError, match=rf"{run} and {checkpoint} are the same weights\. Name each once"):
        study("robustness", str(run), str(checkpoint), "--data", dataset)
    (tmp_path / "x.zarr" / "grid").mkdir(parents=True)
    (tmp_path / "x.zarr" / "grid" / "zarr.json").write_text("{}")
    with pytest.raises(RecipeError, match="is the dataset"):
        study("robustness", str(run), "--data", dataset, "--out", str(tmp_path / "x.zarr" / "study"))


def test_rows_of_other_weights_in_the_same_place_are_not_kept(dataset: str, run: Path, tmp_path: Path) -> None:
    options = argparse.Namespace(runs=[str(run)], checkpoint="result", out=None)
    before = about_weights(weights_of(options))
    shutil.rmtree(run)
    train(tiny_training(seed=1), data=dataset, run=run)
    assert about_weights(weights_of(options)) != before


def test_results_of_one_run_go_below_its_evaluations(run: Path) -> None:
    options = argparse.Namespace(runs=[str(run)], checkpoint=4, out=None)
    assert folder_of(options, weights_of(options), "robustness") == run / "evaluation-step-4" / "robustness"


def test_generalisation_to_a_persons_own_data(
    dataset: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = imported_kind(dataset)
    monkeypatch.setattr("workflows.studies.generalisation.make_kinds", lambda *_, **__: [made])
    (tmp_path / "mine.zarr").symlink_to(dataset)
    out = tmp_path / "study"
    study("generalisation", str(run), "--data", str(tmp_path / "mine.zarr"), "--out", str(out), "--triples", "3")
    text = (out / "generalisation.md").read_text()
    assert text in capsys.readouterr().out and "| mine 32" in text and "| leg 32" in text
    assert all((out / name).stat().st_size for name in ("rows.csv", "heat-map.png", "examples.png"))


def test_generalisation_refuses_what_has_no_transfer(run: Path) -> None:
    with pytest.raises(RecipeError, match=r"--identities 1 .*two identities"):
        study("generalisation", str(run), "--identities", "1")


def test_data_of_other_sizes_are_made_anew(tmp_path: Path) -> None:
    base = DatasetRecipe()
    for poses in (2, 3):
        sizes = Sizes(identities=2, poses=poses, triples=2)
        (kind,) = make_kinds(base, ["notoes_collapse3pc"], [], tmp_path, sizes, say=print)
        assert kind.dataset.recipe.poses.seen == poses


def test_a_study_waits_for_nobody_in_its_folder_and_makes_nothing_there(
    dataset: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workflows.studies.generalisation.make_kinds", lambda *_, **__: pytest.fail("data were made"))
    for name, data in (("robustness", ["--data", dataset]), ("generalisation", [])):
        with EvaluationFolder(tmp_path / name).alone(), pytest.raises(WorkflowError, match="another command is at wor"):
            study(name, str(run), *data, "--out", str(tmp_path / name), "--triples", "2")


def test_people_are_the_same_in_every_topology_and_new() -> None:
    base = DatasetRecipe.model_validate({"body": {"family": "anny", "phenotypes": {"age": (0, 1)}}})
    sizes = Sizes(identities=2, poses=2, triples=2)
    coarse, fine = (people_recipe(base, name, sizes) for name in ("notoes_collapse3pc", "notoes_collapse5pc"))
    assert isinstance(fine.body, AnnyBody) and fine.body.phenotypes.age == (0, 1) and fine.identities.seed == sizes.seed
    (first, *_), (second, *_) = (vertices_of(its, shards_of(its)[0]) for its in (coarse, fine))
    assert first.shape[1:] == (369, 3) and second.shape[1:] == (615, 3)
    np.testing.assert_allclose(np.ptp(first, axis=1), np.ptp(second, axis=1), atol=0.06)


def test_recipes_of_other_bodies_lend_poses_only_where_people_can_take_them() -> None:
    animals = animals_recipe(Sizes())
    people = people_recipe(animals, "anny", Sizes())
    assert isinstance(people.body, AnnyBody) and people.poses.distribution == NptPoses()


def test_a_run_knows_its_data_as_long_as_that_is_there(dataset: str, tmp_path: Path) -> None:
    assert own_recipe(tmp_path) is None
    uuid, run = open_dataset(dataset).uuid, tmp_path / "run"

    def note(**about: str) -> None:
        run.mkdir(exist_ok=True)
        (run / "provenance.json").write_text(json.dumps({"dataset": about}))

    note(url=dataset, uuid=uuid)
    own = own_recipe(run)
    assert own == tiny_dataset() and own_kind(own, [imported_kind(dataset)]) == "leg 32"
    note(url=str(tmp_path / "gone.zarr"), uuid=uuid)
    assert own_recipe(run) is None
    shutil.copytree(dataset, tmp_path / "dataset.zarr")
    assert own_recipe(run) == tiny_dataset(), "both were moved together"
    note(url=dataset, uuid="of other data")
    assert own_recipe(run) is None


def test_examples_show_every_other_kind_and_mark_what_has_no_truth(dataset: str, tmp_path: Path) -> None:
    other = generate(tiny_dataset(poses={"seen": 6, "unseen": 4, "seed": 5}), str(tmp_path / "other.zarr"))
    kinds = [imported_kind(dataset), imported_kind(other.url)]
    assert not have_truth(*kinds)
    shown = examples(kinds, kinds[0].name)
    assert [its.truth_known for its in shown] == [True, False, False]
    assert open_dataset(dataset).uuid != other.uuid
