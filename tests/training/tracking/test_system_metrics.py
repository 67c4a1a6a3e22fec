"""The machine's load, with GPUs by pynvml, by nvidia-smi, and without."""

import logging
import sys
import types
from pathlib import Path

import pytest

from training.tracking.journal import read_journal
from training.tracking.system_metrics import MachineLoad, gpu_reader, sampling


def test_load_under_the_names_of_mlflow(tmp_path: Path) -> None:
    load = MachineLoad(tmp_path)
    found = load.read()
    assert 0 <= found["system/cpu_utilization_percentage"] <= 100
    assert 0 < found["system/system_memory_usage_megabytes"] < 1e8
    assert 0 < found["system/disk_usage_percentage"] <= 100
    assert all(key.startswith("system/") and isinstance(value, float) for key, value in found.items())


class NVMLError(Exception):
    pass


def nvml(*use: float | None) -> types.SimpleNamespace:
    """A driver's library with GPUs of such use; None: of one that does not tell it."""

    def rates(gpu: int) -> types.SimpleNamespace:
        if use[gpu] is None:
            raise NVMLError("Not Supported")
        return types.SimpleNamespace(gpu=use[gpu])

    return types.SimpleNamespace(
        nvmlInit=lambda: None,
        nvmlDeviceGetCount=lambda: len(use),
        nvmlDeviceGetHandleByIndex=lambda index: index,
        nvmlDeviceGetMemoryInfo=lambda handle: types.SimpleNamespace(used=2e9, total=8e9),
        nvmlDeviceGetUtilizationRates=rates,
        NVMLError=NVMLError,
    )


def test_gpus_by_pynvml_and_what_one_does_not_tell_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", nvml(50, 51, None))
    found = gpu_reader()()
    assert found["gpu_1_utilization_percentage"] == 51 and found["gpu_0_memory_usage_megabytes"] == 2000
    assert found["gpu_1_memory_usage_percentage"] == 25 and len(found) == 8
    assert "gpu_2_utilization_percentage" not in found and found["gpu_2_memory_usage_percentage"] == 25


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
    monkeypatch.setitem(sys.modules, "pynvml", None)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    found = gpu_reader()()
    if expected is None:
        assert found == {}
        return
    names = ("utilization_percentage", "memory_usage_megabytes", "memory_usage_percentage")
    assert tuple(found[f"gpu_0_{name}"] for name in names) == pytest.approx(expected) and len(found) == 6


def test_no_gpu_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert gpu_reader()() == {}


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
