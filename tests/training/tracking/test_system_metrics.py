"""The machine's load, with GPUs by nvidia-smi, and without."""

import logging
from pathlib import Path

import pytest

from training.tracking.journal import read_journal
from training.tracking.system_metrics import MachineLoad, gpu_load, sampling


def test_load_under_the_names_of_mlflow(tmp_path: Path) -> None:
    load = MachineLoad(tmp_path)
    found = load.read()
    assert 0 <= found["system/cpu_utilization_percentage"] <= 100
    assert 0 < found["system/system_memory_usage_megabytes"] < 1e8
    assert 0 < found["system/disk_usage_percentage"] <= 100
    assert all(key.startswith("system/") and isinstance(value, float) for key, value in found.items())


@pytest.mark.parametrize(
    ("answer", "expected"),
    [("87, 1000, 4000\n12, 0, 4000", (87.0, 1048.576, 25.0)), ("[N/A], [N/A], [N/A]", None), ("", None)],
)
def test_gpus_by_nvidia_smi(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str, expected: tuple[float, ...] | None
) -> None:
    program = tmp_path / "nvidia-smi"
    program.write_text(f"#!/bin/sh\nprintf '{answer}'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    found = gpu_load()
    if expected is None:
        assert found == {}
        return
    names = ("utilization_percentage", "memory_usage_megabytes", "memory_usage_percentage")
    assert tuple(found[f"gpu_0_{name}"] for name in names) == pytest.approx(expected) and len(found) == 6


def test_no_gpu_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert gpu_load() == {}


def test_sampling_goes_on_where_it_was_and_never_stops_the_work(tmp_path: Path, caplog) -> None:
    import time

    for _ in range(2):
        with sampling(tmp_path / "system.jsonl", every=0.02):
            time.sleep(0.15)
    rows = read_journal(tmp_path / "system.jsonl")
    assert [row["step"] for row in rows] == list(range(len(rows))) and len(rows) >= 4
    (tmp_path / "file").write_text("")
    with caplog.at_level(logging.WARNING), sampling(tmp_path / "file" / "system.jsonl", every=0.02):
        pass
    assert "no longer noted" in caplog.text
    caplog.clear()
    (tmp_path / "run" / "system.jsonl").mkdir(parents=True)
    with caplog.at_level(logging.WARNING), sampling(tmp_path / "run" / "system.jsonl", every=0.02):
        pass
    assert "no longer noted" in caplog.text and "is not a regular file" in caplog.text
