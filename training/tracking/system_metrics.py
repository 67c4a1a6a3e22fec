"""The load of this machine, under the names that MLflow gives to system metrics, so that its UI shows them as such."""

import contextlib
import importlib
import logging
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil

from datagen.common.errors import DsffnetError
from training.tracking.journal import Journal
from training.tracking.threads import background

log = logging.getLogger(__name__)
_QUERY = ("nvidia-smi", "--query-gpu=utilization.gpu,memory.used,memory.total", "--format=csv,noheader,nounits")
_MIB = 1.048576  # megabytes in one, which nvidia-smi counts in


@contextmanager
def sampling(path: Path, *, every: float = 5.0) -> Iterator[None]:
    """Append this machine's load to the journal ``path`` while the block runs; failing to is no reason to stop it."""
    with background(lambda stop: _sample(path, stop, every), name="machine-load"):
        yield


class MachineLoad:
    """Reads CPU, memory, disk, network and, where there is an NVIDIA driver, each GPU."""

    def __init__(self, place: Path) -> None:
        """``place``: a folder on the disk whose use is told."""
        self._place, self._gpus = place, gpu_reader()
        self._disk, self._network = psutil.disk_io_counters(), psutil.net_io_counters()
        psutil.cpu_percent()  # the first call only begins the interval

    def read(self) -> dict[str, float]:
        """The load now; disk and network traffic since this object was made."""
        memory = psutil.virtual_memory()
        found = {
            "cpu_utilization_percentage": psutil.cpu_percent(),
            "system_memory_usage_megabytes": memory.used / 1e6,
            "system_memory_usage_percentage": memory.percent,
            "disk_usage_percentage": psutil.disk_usage(str(self._place)).percent,
        }
        disk, network = psutil.disk_io_counters(), psutil.net_io_counters()
        if disk and self._disk:
            found["disk_read_megabytes"] = (disk.read_bytes - self._disk.read_bytes) / 1e6
            found["disk_write_megabytes"] = (disk.write_bytes - self._disk.write_bytes) / 1e6
        if network and self._network:
            found["network_receive_megabytes"] = (network.bytes_recv - self._network.bytes_recv) / 1e6
            found["network_transmit_megabytes"] = (network.bytes_sent - self._network.bytes_sent) / 1e6
        return {f"system/{name}": float(value) for name, value in (found | self._gpus()).items()}


def gpu_reader() -> Callable[[], dict[str, float]]:
    """What reads use (percent) and memory (megabytes) of each GPU: pynvml, else nvidia-smi, else nothing."""
    try:
        nvml = importlib.import_module("pynvml")
        nvml.nvmlInit()
        handles = [nvml.nvmlDeviceGetHandleByIndex(index) for index in range(nvml.nvmlDeviceGetCount())]
    except Exception:  # not installed, or no driver; pynvml has an exception class for each reason
        return _from_nvidia_smi if shutil.which(_QUERY[0]) else dict

    def read() -> dict[str, float]:
        return _named([_row(nvml, handle) for handle in handles])

    return read


def _row(nvml: Any, handle: Any) -> tuple[float | None, ...]:
    """Use, memory used and memory in all of one GPU; None for what it does not tell (its parts under MIG, say)."""
    use = memory = None
    with contextlib.suppress(nvml.NVMLError):
        use = nvml.nvmlDeviceGetUtilizationRates(handle).gpu
    with contextlib.suppress(nvml.NVMLError):
        memory = nvml.nvmlDeviceGetMemoryInfo(handle)
    return use, memory and memory.used / 1e6, memory and memory.total / 1e6


def _from_nvidia_smi() -> dict[str, float]:
    try:
        done = subprocess.run(_QUERY, capture_output=True, encoding="utf-8", errors="replace", timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return {}
    rows = [[_number(value) for value in line.split(",")] for line in done.stdout.splitlines() if line.count(",") == 2]
    return _named([(use, used and used * _MIB, total and total * _MIB) for use, used, total in rows])


def _number(text: str) -> float | None:
    """None for "[N/A]", on a GPU that is cut in parts."""
    try:
        return float(text)
    except ValueError:
        return None


def _named(rows: list[tuple[float | None, ...]]) -> dict[str, float]:
    found = {}
    for index, (use, used, total) in enumerate(rows):
        found[f"gpu_{index}_utilization_percentage"] = use
        found[f"gpu_{index}_memory_usage_megabytes"] = used
        found[f"gpu_{index}_memory_usage_percentage"] = 100 * used / total if used is not None and total else None
    return {name: value for name, value in found.items() if value is not None}


def _sample(path: Path, stop: threading.Event, every: float) -> None:
    try:
        with contextlib.closing(Journal(path)) as journal:
            load, step, is_over = MachineLoad(path.parent), journal.next_step, False
            while not is_over:
                is_over = stop.wait(every)
                journal.write(step, load.read())  # once more at the end, so that what takes seconds has its line
                step += 1
    except (DsffnetError, OSError, psutil.Error) as error:
        log.warning("the load of this machine is no longer noted in %s: %s", path, error)
