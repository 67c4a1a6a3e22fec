"""Checkpoints named after the accidents."""

import hashlib
import logging
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from datagen.common.errors import CheckpointError, StorageError
from tests.support.files import flip_bit, truncate
from training.checkpoints import weights
from training.checkpoints.checkpoint import export_weights, load_checkpoint, require_checkpoint, save_checkpoint
from training.checkpoints.weights import fill_network
from training.engine.distributed import random_state, restore_random_state


def save(run: Path, step: int, keep: int = 3, recipe: dict[str, Any] | None = None, **more: Any) -> Path:
    values = {"layer.weight": torch.full((2, 3), float(step))}
    about = {"step": step, "recipe": recipe or {"batch": step}, "dataset": "uuid", "dataset_sha256": "abc"}
    return save_checkpoint(run, about=about, weights=values, state={"optimiser": {"step": step}}, keep=keep, **more)


def names(run: Path) -> list[int]:
    return [int(path.name.removeprefix("step-")) for path in sorted((run / "checkpoints").iterdir())]


def test_newest_is_read_and_only_the_last_few_are_kept(tmp_path: Path) -> None:
    for step in (5, 10, 15, 100):
        save(tmp_path, step)
    found = require_checkpoint(tmp_path)
    assert (found.step, found.recipe, found.dataset, found.dataset_sha256) == (100, {"batch": 100}, "uuid", "abc")
    assert found.versions["torch"] == torch.__version__
    assert torch.equal(found.weights()["layer.weight"], torch.full((2, 3), 100.0))
    assert found.state() == {"optimiser": {"step": 100}}
    assert names(tmp_path) == [10, 15, 100]
    assert (tmp_path / "latest").read_text() == "step-00000100\n"


def test_the_best_outlives_the_newest_few(tmp_path: Path) -> None:
    for step in range(1, 8):
        save(tmp_path, step, keep=2, best=step in (1, 3))
    assert names(tmp_path) == [3, 6, 7]
    assert (tmp_path / "best").read_text() == "step-00000003\n"
    found = load_checkpoint(tmp_path, "best")
    assert found is not None and found.step == 3 and found.best
    newest = load_checkpoint(tmp_path)
    assert newest is not None and newest.step == 7 and not newest.best


def test_killed_before_the_best_was_named_it_is_still_the_best(tmp_path: Path) -> None:
    save(tmp_path, 1, best=True)
    before = (tmp_path / "best").read_text()
    save(tmp_path, 2, best=True)
    (tmp_path / "best").write_text(before)
    for step in (3, 4, 5):
        save(tmp_path, step, keep=1)
    assert require_checkpoint(tmp_path, "best").step == 2 and names(tmp_path) == [2, 5]


def test_a_step_saved_again_as_the_best_becomes_it(tmp_path: Path) -> None:
    folder = save(tmp_path, 1)
    written = (folder / "weights.safetensors").stat().st_mtime_ns
    save(tmp_path, 1, best=True)
    assert require_checkpoint(tmp_path, "best").step == 1
    assert (folder / "weights.safetensors").stat().st_mtime_ns == written


@pytest.mark.parametrize("spoil", [flip_bit, truncate, Path.unlink])
@pytest.mark.parametrize("name", ["weights.safetensors", "state.pt", "manifest.json"])
def test_a_damaged_best_is_an_error_and_never_another(tmp_path: Path, spoil, name: str) -> None:
    save(tmp_path, 1, best=True)
    spoil(save(tmp_path, 2, best=True) / name)
    save(tmp_path, 3)
    with pytest.raises(CheckpointError, match=r"step-00000002 is damaged or missing"):
        load_checkpoint(tmp_path, "best")
    assert require_checkpoint(tmp_path).step == 3


def test_a_run_without_a_best(tmp_path: Path) -> None:
    save(tmp_path, 1)
    assert load_checkpoint(tmp_path, "best") is None
    with pytest.raises(CheckpointError, match=r"no best checkpoint.*Take the newest one"):
        require_checkpoint(tmp_path, "best")


@pytest.mark.parametrize("spoil", [flip_bit, truncate, Path.unlink])
@pytest.mark.parametrize("name", ["weights.safetensors", "average.safetensors", "state.pt", "manifest.json"])
def test_a_damaged_newest_falls_back_and_says_so(tmp_path: Path, caplog, spoil, name: str) -> None:
    save(tmp_path, 1)
    newest = save(tmp_path, 2, average={"layer.weight": torch.zeros(2, 3)})
    spoil(newest / name)
    with caplog.at_level(logging.WARNING):
        found = load_checkpoint(tmp_path)
    assert found is not None and found.step == 1
    assert "step-00000002" in caplog.text and "damaged" in caplog.text


@pytest.mark.parametrize("average", [None, {"layer.weight": torch.zeros(2, 3)}], ids=["weights", "average"])
def test_inference_verifies_the_file_that_it_loads_and_no_other(tmp_path: Path, average: Any) -> None:
    folder = save(tmp_path, 1, average=average)
    for name in ("state.pt", "weights.safetensors")[: 1 if average is None else 2]:
        flip_bit(folder / name)
    for place, which in ((tmp_path, "latest"), (tmp_path, 1), (folder, "latest")):
        found = load_checkpoint(place, which, weights_only=True)
        assert found is not None and found.weights(average=True)["layer.weight"][0, 0] == (average is None)
    flip_bit(folder / ("weights.safetensors" if average is None else "average.safetensors"))
    assert load_checkpoint(tmp_path, weights_only=True) is None


def test_a_file_is_hashed_once_in_a_process_until_it_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, read = tmp_path / "run", []
    folder, real = save(run, 1), hashlib.file_digest
    for path in folder.iterdir():
        os.utime(path, (1, 1))

    def digest(file: Any, kind: str) -> Any:
        read.append(Path(os.readlink(f"/proc/self/fd/{file.fileno()}")).name)
        return real(file, kind)

    monkeypatch.setattr(hashlib, "file_digest", digest)
    for _ in range(3):
        require_checkpoint(require_checkpoint(run, weights_only=True).path, weights_only=True)
    assert read == ["weights.safetensors"]
    assert require_checkpoint(run).step == 1 and read == ["weights.safetensors", "state.pt"]
    flip_bit(folder / "weights.safetensors")
    assert load_checkpoint(run, weights_only=True) is None


@pytest.mark.parametrize("at", [0.1, 0.3, 0.7])
def test_a_flipped_bit_anywhere_in_the_manifest_is_found(tmp_path: Path, at: float) -> None:
    flip_bit(save(tmp_path, 1) / "manifest.json", at=at)
    assert load_checkpoint(tmp_path) is None


@pytest.mark.parametrize("spoil", [flip_bit, truncate, shutil.rmtree])
def test_a_named_checkpoint_that_is_damaged_is_an_error(tmp_path: Path, spoil) -> None:
    save(tmp_path, 1)
    named = save(tmp_path, 2)
    spoil(named if spoil is shutil.rmtree else named / "weights.safetensors")
    not_there = "not there" if spoil is shutil.rmtree else "damaged or missing"
    for asked, says in [
        (lambda: require_checkpoint(named), "damaged or missing"),
        (lambda: load_checkpoint(tmp_path, 2), not_there),
    ]:
        with pytest.raises(CheckpointError, match=rf"step-00000002 is {says}.*Name another"):
            asked()
    with pytest.raises(CheckpointError):
        require_checkpoint(named / "weights.safetensors")


@pytest.mark.parametrize("spoil", [flip_bit, truncate, Path.unlink])
def test_weights_copied_away_from_their_checkpoint_know_themselves(tmp_path: Path, spoil) -> None:
    alone = Path(shutil.copy(save(tmp_path, 7) / "weights.safetensors", tmp_path / "mine.safetensors"))
    found = require_checkpoint(alone)
    assert (found.step, found.recipe) == (7, {"batch": 7}) and found.weights()["layer.weight"][0, 0] == 7
    with pytest.raises(CheckpointError, match="weights only"):
        found.state()
    spoil(alone, at=0.99) if spoil is flip_bit else spoil(alone)
    with pytest.raises(CheckpointError, match=r"mine\.safetensors"):
        require_checkpoint(alone)


def test_a_file_of_holes_is_a_fault_at_once(tmp_path: Path) -> None:
    save(tmp_path, 1)
    os.truncate(save(tmp_path, 2) / "state.pt", 2**40)
    found = load_checkpoint(tmp_path)
    assert found is not None and found.step == 1


def test_a_file_of_nothing_but_zeros_is_refused_by_its_header(tmp_path: Path) -> None:
    """Before it is mapped, for which there may be no room."""
    path = tmp_path / "mine.safetensors"
    path.touch()
    os.truncate(path, 2**36)
    with pytest.raises(CheckpointError, match="header would have 0 bytes"):
        require_checkpoint(path)


def test_none_or_all_damaged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert load_checkpoint(tmp_path) is None
    with pytest.raises(CheckpointError, match=r"no usable checkpoint\. Name the folder of a training"):
        require_checkpoint(tmp_path)
    flip_bit(save(tmp_path, 1) / "weights.safetensors")
    for _ in range(2):
        with pytest.raises(CheckpointError, match=r"no sound checkpoint: 1 of 1 are damaged\. .* again from step 0"):
            require_checkpoint(tmp_path)
    assert [record.getMessage().endswith("and passed over") for record in caplog.records] == [True], "once"


def test_disk_full_keeps_the_last_good_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(tmp_path, 1, best=True)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    for module, name in ((weights, "save_file"), (torch, "save"), (os, "fsync")):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, full)
            with pytest.raises(StorageError, match="step-00000002: No space left on device"):
                save(tmp_path, 2, best=True)
        assert require_checkpoint(tmp_path).step == require_checkpoint(tmp_path, "best").step == 1
        assert names(tmp_path) == [1]


def test_everything_reaches_the_disk_before_the_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    sync, replace = os.fsync, os.replace

    def synced(descriptor: int) -> None:
        done.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")).name)
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append(f"-> {Path(b).name}"), replace(a, b)))
    save(tmp_path, 1, best=True, average={"layer.weight": torch.zeros(2, 3)})
    before = done[: done.index("-> step-00000001")]
    assert {"weights.safetensors", "average.safetensors", "state.pt"} < set(before[: before.index("-> manifest.json")])
    assert before[-3].startswith(".manifest.json.") and before[-1].startswith(".partial-"), "the manifest, its name"
    named = [name for name in done if name.startswith("->")]
    assert named[-2:] == ["-> best", "-> latest"] and done[len(before) + 1] == "checkpoints", "then the folder's name"


def test_what_a_kill_left_half_written_is_never_read(tmp_path: Path) -> None:
    save(tmp_path, 1)
    half = tmp_path / "checkpoints" / ".partial-x"
    half.mkdir()
    (half / "weights.safetensors").write_bytes(b"half")
    assert require_checkpoint(tmp_path).step == 1
    save(tmp_path, 2)
    assert not half.exists()


def test_a_damaged_old_one_never_counts_among_those_kept(tmp_path: Path) -> None:
    for step in (1, 2, 3):
        folder = save(tmp_path, step)
    flip_bit(folder / "state.pt")
    save(tmp_path, 4, keep=2)
    assert names(tmp_path) == [2, 4]


def test_the_average_is_a_file_of_its_own(tmp_path: Path) -> None:
    save(tmp_path, 1, average={"layer.weight": torch.full((2, 3), 0.5)})
    found = require_checkpoint(tmp_path)
    assert found.weights()["layer.weight"][0, 0] == 1 and found.weights(average=True)["layer.weight"][0, 0] == 0.5
    save(tmp_path, 2)
    assert require_checkpoint(tmp_path).weights(average=True)["layer.weight"][0, 0] == 2


def test_exported_weights_load_without_the_optimiser(tmp_path: Path) -> None:
    save(tmp_path / "run", 7, average={"layer.weight": torch.full((2, 3), 0.1)})
    for dtype in (None, torch.bfloat16, torch.float16):
        folder = tmp_path / f"weights-{dtype}"
        export_weights(require_checkpoint(tmp_path / "run"), folder, dtype=dtype)
        found = require_checkpoint(folder)
        value = found.weights()["layer.weight"]
        assert found.step == 7 and value.dtype == (dtype or torch.float32)
        assert value[0, 0] == torch.tensor(0.1, dtype=dtype), "the average is what is exported"
        assert sorted(path.name for path in folder.iterdir()) == ["manifest.json", "weights.safetensors"]
        with pytest.raises(CheckpointError, match="weights only"):
            found.state()
    flip_bit(folder / "weights.safetensors")
    with pytest.raises(CheckpointError, match="damaged"):
        require_checkpoint(folder)


def test_exported_weights_do_not_tell_where_the_first_ones_lay(tmp_path: Path) -> None:
    recipe = {"start_from": "/home/somebody/secret/first-run"}
    save(tmp_path / "run", 7, recipe=recipe)
    export_weights(require_checkpoint(tmp_path / "run"), tmp_path / "weights")
    assert require_checkpoint(tmp_path / "weights").recipe == {"start_from": "first-run"}
    assert all(b"secret" not in path.read_bytes() for path in (tmp_path / "weights").iterdir())


def test_weights_too_large_for_half_precision_are_refused(tmp_path: Path) -> None:
    save(tmp_path, 70_000)
    with pytest.raises(CheckpointError, match=r"layer\.weight reaches 7e\+04, more than torch\.float16 can hold"):
        export_weights(require_checkpoint(tmp_path), tmp_path / "half", dtype=torch.float16)


def test_weights_of_another_network_are_refused_by_name_and_shape() -> None:
    network = nn.Sequential(nn.Linear(3, 4), nn.Linear(4, 2))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    given = before | {"0.weight": torch.zeros(4, 5), "extra": torch.zeros(1)}
    del given["1.bias"]
    with pytest.raises(CheckpointError) as caught:
        fill_network(network, given, where="runs/other")
    for words in ("runs/other", "missing: 1.bias [2]", "unexpected: extra [1]", "0.weight [4, 5] (the network's is [4"):
        assert words in str(caught.value)
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())
    fill_network(network, {name: value + 1 for name, value in before.items()}, where="runs/same")
    assert torch.equal(network[1].bias, before["1.bias"] + 1)


def test_random_states_survive_a_checkpoint(tmp_path: Path) -> None:
    torch.manual_seed(5)
    about = {"step": 1, "recipe": {}, "dataset": "uuid"}
    values = {"w": torch.zeros(1)}
    save_checkpoint(tmp_path, about=about, weights=values, state={"random": [random_state()]}, keep=1)
    expected = torch.rand(4)
    torch.manual_seed(6)
    states = require_checkpoint(tmp_path).state()["random"]
    restore_random_state(states, rank=3)  # a rank that the checkpoint does not know
    assert not torch.equal(torch.rand(4), expected)
    restore_random_state(states, rank=0)
    assert torch.equal(torch.rand(4), expected)
