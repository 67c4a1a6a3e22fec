"""The load of this machine, under the names that MLflow gives to system metrics, so that its UI shows them as such."""

import contextlib
import logging
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
    """Reads CPU, memory, disk, network and, where there is nvidia-smi, each GPU."""

    def __init__(self, place: Path) -> None:
        """``place``: a folder on the disk whose use is told."""
        self._place = place
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
        return {f"system/{name}": float(value) for name, value in (found | gpu_load()).items()}


def gpu_load() -> dict[str, float]:
    """Use (percent) and memory (megabytes) of each GPU, as nvidia-smi tells them; nothing where there is none."""
    try:
        done = subprocess.run(_QUERY, capture_output=True, encoding="utf-8", errors="replace", timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return {}
    rows = [[_number(value) for value in line.split(",")] for line in done.stdout.splitlines() if line.count(",") == 2]
    found = {}
    for index, (use, used, total) in enumerate(rows):
        found[f"gpu_{index}_utilization_percentage"] = use
        found[f"gpu_{index}_memory_usage_megabytes"] = used and used * _MIB
        found[f"gpu_{index}_memory_usage_percentage"] = 100 * used / total if used is not None and total else None
    return {name: value for name, value in found.items() if value is not None}


def _number(text: str) -> float | None:
    """None for "[N/A]", on a GPU that is cut in parts."""
    try:
        return float(text)
    except ValueError:
        return None


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
