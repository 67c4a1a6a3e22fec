"""A workflow's folder that was moved or copied is known by its content; two evaluations of one run take turns."""

import shutil
from pathlib import Path

import pytest

from datagen.common.errors import WorkflowError
from datagen.generate import generate
from tests.support.recipes import tiny_dataset, tiny_training
from training.recipes.training import EvaluationRecipe
from training.tracking.record import about_dataset, read_record
from workflows.pipeline.evaluate import evaluate_weights, is_evaluated
from workflows.pipeline.run_folder import EvaluationFolder, RunFolder
from workflows.pipeline.tasks import TaskRunner
from workflows.pipeline.train import is_trained, train_model
from workflows.pipeline.weights_argument import evaluated
from workflows.studies.common import about_weights

RECIPE = EvaluationRecipe(emd_points=16, examples=1, chunk=4)


@pytest.fixture(scope="module")
def workflow(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, a training and its evaluation in one folder, made in this process."""
    out = tmp_path_factory.mktemp("workflow") / "out"
    shutil.copytree(_pristine, out / "dataset.zarr")
    tasks = TaskRunner(local=True)
    train_model(tiny_training(), str(out / "dataset.zarr"), RunFolder(out / "run"), parent=None, tasks=tasks)
    evaluate_weights(RECIPE, str(out / "dataset.zarr"), out / "run", parent=out / "run", tasks=tasks)
    return out


def test_what_was_moved_is_as_finished_as_before(workflow: Path, tmp_path: Path) -> None:
    weights = about_weights([evaluated(workflow / "run")])
    copied = Path(shutil.copytree(workflow, tmp_path / "copied"))
    for rename in (False, True):
        moved = copied.rename(tmp_path / "moved") if rename else copied
        data, run = str(moved / "dataset.zarr"), moved / "run"
        assert is_trained(tiny_training(), data, run) and is_evaluated(RECIPE, data, RunFolder(run))
        assert about_weights([evaluated(run)]) == weights, "studies of the weights are kept, too"
    other = generate(tiny_dataset(poses={"seen": 6, "unseen": 4, "seed": 5}), str(tmp_path / "other.zarr"))
    assert not is_evaluated(RECIPE, other.url, RunFolder(tmp_path / "moved" / "run")), "other content at any place"
    record = read_record(tmp_path / "moved" / "run" / "evaluation")
    assert record is not None and record.dataset != about_dataset(other)


def test_a_second_evaluation_of_one_run_says_so_and_changes_nothing(workflow: Path) -> None:
    folder = workflow / "run" / "evaluation"
    before = (folder / "record.json").read_bytes()
    with (
        EvaluationFolder(folder).alone(),
        pytest.raises(WorkflowError, match=r"another command is at work in .*run/evaluation\."),
    ):
        evaluate_weights(
            RECIPE, str(workflow / "dataset.zarr"), workflow / "run", parent=None, tasks=TaskRunner(local=True)
        )
    assert (folder / "record.json").read_bytes() == before
