"""What comes first when a training starts, and what rank 0 alone may fail at."""

import errno
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from datagen.common.errors import DatasetError, StorageError, TrainingError, TrainingStopped
from datagen.generate import generate
from tests.support.recipes import tiny_dataset, tiny_training
from training.engine import trainer
from training.engine.distributed import STOP_FILE, Ranks, agreed, decided_by_first, on_sigterm
from training.engine.state import Verdict
from training.engine.tasks.transfer import transfer_task, validation
from training.engine.trainer import train

ALONE = Ranks(0, 1, 0)


def must_not_be_called(*_: object, **__: object) -> Any:
    raise AssertionError("opened although there is nothing to do with it")


def test_a_finished_run_opens_neither_meshes_nor_journal(dataset: str, tmp_path: Path, monkeypatch) -> None:
    train(tiny_training(), data=dataset, run=tmp_path)
    monkeypatch.setattr(transfer_task, "open_bank", must_not_be_called)
    monkeypatch.setattr(trainer, "observing", must_not_be_called)
    assert train(tiny_training(), data=dataset, run=tmp_path) == 8


def test_a_start_that_has_gone_is_not_missed_on_resume(dataset: str, tmp_path: Path) -> None:
    train(tiny_training(), data=dataset, run=tmp_path / "first")
    recipe = tiny_training(start_from=str(tmp_path / "first"))
    train(recipe, data=dataset, run=tmp_path / "second")
    (tmp_path / "first").rename(tmp_path / "elsewhere")
    newest = tmp_path / "second" / "checkpoints" / "step-00000008"
    newest.rename(tmp_path / "away")
    assert train(recipe, data=dataset, run=tmp_path / "second") == 8


def test_a_left_over_stop_is_removed_and_one_made_since_is_heeded(dataset: str, tmp_path: Path, monkeypatch) -> None:
    tomorrow = time.time() + 86_400  # of a clock that was put back since
    for number, moment in enumerate((1.0, tomorrow)):
        run = tmp_path / str(number)
        run.mkdir()
        (run / STOP_FILE).touch()
        os.utime(run / STOP_FILE, (moment, moment))
        assert train(tiny_training(), data=dataset, run=run) == 8
        assert not (run / STOP_FILE).exists()
    real = transfer_task.open_bank

    def told_meanwhile(*arguments: Any, **keywords: Any) -> Any:
        (tmp_path / "run" / STOP_FILE).touch()
        return real(*arguments, **keywords)

    monkeypatch.setattr(transfer_task, "open_bank", told_meanwhile)
    with pytest.raises(TrainingStopped, match="step 0 of 8 as told; before anything was learned"):
        train(tiny_training(), data=dataset, run=tmp_path / "run")


def test_a_stop_for_ranks_that_were_not_up_yet_is_kept_where_a_launcher_keeps_it(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / STOP_FILE).touch()
    os.utime(tmp_path / STOP_FILE, (1, 1))
    monkeypatch.setattr(trainer.dist, "is_initialized", lambda: True)
    with pytest.raises(TrainingStopped):
        train(tiny_training(), data=dataset, run=tmp_path)


def test_early_stopping_without_evaluation_triples_is_refused_first(tmp_path: Path, monkeypatch) -> None:
    data = str(tmp_path / "none.zarr")
    generate(tiny_dataset(triples={"count": 0}), data)
    monkeypatch.setattr(transfer_task, "open_bank", must_not_be_called)
    with pytest.raises(DatasetError, match=r"early_stopping is 2, but .*none\.zarr lists no evaluation triples"):
        train(tiny_training(early_stopping=2), data=data, run=tmp_path / "run")


def test_pictures_are_drawn_when_they_are_due(dataset: str, tmp_path: Path) -> None:
    train(tiny_training(picture_every=4), data=dataset, run=tmp_path)
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == ["step-00000004.png", "step-00000008.png"]


def test_a_picture_that_cannot_be_written_is_a_warning(dataset: str, tmp_path: Path, caplog, monkeypatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(validation, "draw_snapshot", full)
    assert train(tiny_training(picture_every=4), data=dataset, run=tmp_path) == 8
    assert "no picture of step 4" in caplog.text and "No space left" in caplog.text


def test_a_journal_that_cannot_be_synced_is_one_storage_error(dataset: str, tmp_path: Path, monkeypatch) -> None:
    journal, fsync = tmp_path / "metrics.jsonl", os.fsync

    def broken(descriptor: int) -> None:
        if journal.exists() and os.path.samestat(os.fstat(descriptor), journal.stat()):
            raise OSError(errno.EIO, "Input/output error")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", broken)
    with pytest.raises(StorageError, match=r"metrics\.jsonl: Input/output error"):
        train(tiny_training(), data=dataset, run=tmp_path)


def test_an_error_of_the_file_system_is_told_as_one_of_storage() -> None:
    def fails() -> None:
        raise OSError(errno.EACCES, "Permission denied", "/there")

    for attempt in (lambda: decided_by_first(ALONE, fails), lambda: agreed(ALONE, fails, what="begin")):
        with pytest.raises(StorageError, match="/there: Permission denied"):
            attempt()


def test_other_ranks_end_with_a_secondary_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.engine.distributed.any_rank", lambda flags, ranks: [True])
    with pytest.raises(TrainingError, match="another rank could not begin") as caught:
        agreed(Ranks(1, 2, 1), lambda: 3, what="begin")
    assert caught.value.secondary


def test_a_best_over_other_triples_is_forgotten() -> None:
    state = Verdict(0.1, 3, False, triples=32).state()
    assert Verdict.resumed(state, triples=32) == Verdict(0.1, 3, False, triples=32)
    assert Verdict.resumed(state, triples=8) == Verdict(triples=8)


def test_in_a_thread_sigterm_is_left_alone_and_errors_have_no_other_cause() -> None:
    before, raised = signal.getsignal(signal.SIGTERM), list[BaseException]()

    def work() -> None:
        try:
            with on_sigterm(lambda: None):
                raise KeyError("its own")
        except KeyError as error:
            raised.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert raised[0].__context__ is None and signal.getsignal(signal.SIGTERM) is before
