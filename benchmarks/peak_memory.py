"""Peak memory of this process. Not ``ru_maxrss``: on Linux a new process inherits that from the one that started it."""

from pathlib import Path


def peak_mebibytes() -> float:
    """Most memory that this process has held so far (Linux: VmHWM)."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def forget_peak() -> None:
    """Begin anew from what is held now."""
    Path("/proc/self/clear_refs").write_text("5")
