"""Checkpoints named after the accidents."""

import logging
from pathlib import Path

import pytest
import torch

from datagen.errors import StorageError
from tests.support.files import flip_bit, truncate
from training import checkpoint as module
from training.checkpoint import CheckpointError, export_weights, load_checkpoint, require_checkpoint, save_checkpoint


def save(run: Path, step: int, keep: int = 3) -> Path:
    weights = {"layer.weight": torch.full((2, 3), float(step))}
    about = {"step": step, "recipe": {"batch": step}, "dataset": "uuid"}
    return save_checkpoint(run, about=about, weights=weights, state={"optimiser": {"step": step}}, keep=keep)


def test_newest_is_read_and_only_the_last_few_are_kept(tmp_path: Path) -> None:
    for step in (5, 10, 15, 100):
        save(tmp_path, step)
    found = require_checkpoint(tmp_path)
    assert (found.step, found.recipe, found.dataset) == (100, {"batch": 100}, "uuid")
    assert torch.equal(found.weights()["layer.weight"], torch.full((2, 3), 100.0))
    assert found.state() == {"optimiser": {"step": 100}}
    assert [path.name for path in sorted((tmp_path / "checkpoints").iterdir())] == [
        "step-00000010", "step-00000015", "step-00000100",
    ]  # fmt: skip
    assert (tmp_path / "latest").read_text() == "step-00000100\n"


@pytest.mark.parametrize("spoil", [flip_bit, truncate, Path.unlink])
@pytest.mark.parametrize("name", ["weights.safetensors", "state.pt", "manifest.json"])
def test_a_damaged_newest_falls_back_and_says_so(tmp_path: Path, caplog, spoil, name: str) -> None:
    save(tmp_path, 1)
    newest = save(tmp_path, 2)
    spoil(newest / name)
    with caplog.at_level(logging.WARNING):
        found = load_checkpoint(tmp_path)
    assert found is not None and found.step == 1
    assert "step-00000002" in caplog.text and "damaged" in caplog.text


def test_none_or_all_damaged(tmp_path: Path) -> None:
    assert load_checkpoint(tmp_path) is None
    flip_bit(save(tmp_path, 1) / "weights.safetensors")
    with pytest.raises(CheckpointError, match=r"no usable checkpoint\. Name the folder of a training"):
        require_checkpoint(tmp_path)


def test_disk_full_keeps_the_last_good_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(tmp_path, 1)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "save_file", full)
    with pytest.raises(StorageError, match="step-00000002: No space left on device"):
        save(tmp_path, 2)
    assert require_checkpoint(tmp_path).step == 1
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["step-00000001"]


def test_what_a_kill_left_half_written_is_never_read(tmp_path: Path) -> None:
    save(tmp_path, 1)
    half = tmp_path / "checkpoints" / ".partial-x"
    half.mkdir()
    (half / "weights.safetensors").write_bytes(b"half")
    assert require_checkpoint(tmp_path).step == 1
    save(tmp_path, 2)
    assert not half.exists()


def test_exported_weights_load_without_the_optimiser(tmp_path: Path) -> None:
    save(tmp_path / "run", 7)
    export_weights(require_checkpoint(tmp_path / "run"), tmp_path / "weights")
    found = require_checkpoint(tmp_path / "weights")
    assert found.step == 7 and found.weights()["layer.weight"][0, 0] == 7
    assert not (tmp_path / "weights" / "state.pt").exists()
