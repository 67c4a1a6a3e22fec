"""Timing on a CPU or a GPU, the memory of a call, and the rates that a device reaches at best."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable

import torch

from training.networks.execution import Precision, products


def release(device: torch.device) -> None:
    """Free what the form before has left, so that it does not count for the next."""
    torch._dynamo.reset()
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


def measured(work: Callable[[], object], device: torch.device) -> tuple[float, float]:
    """Seconds of one call (the least of several) and the GiB at its peak over what was held before."""
    for _ in range(3):
        work()
    held = 0
    if device.type == "cuda":
        held = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
    seconds = least_of(work, device)
    peak = (torch.cuda.max_memory_allocated(device) - held) / 2**30 if device.type == "cuda" else float("nan")
    return seconds, peak


def least_of(work: Callable[[], object], device: torch.device) -> float:
    """Seconds of the quickest of three to twenty calls, as many as fit into two seconds."""
    end = time.monotonic() + (2 if device.type == "cuda" else 0)
    taken: list[float] = []
    while len(taken) < 3 or (len(taken) < 20 and time.monotonic() < end):
        taken.append(timed(work, device))
    return min(taken)


def timed(work: Callable[[], object], device: torch.device) -> float:
    """Seconds of one call, the device's work included."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    start = time.perf_counter()
    work()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - start


def matrix_rate(how: Precision, device: torch.device) -> float:
    """TFLOP/s of a large product in a precision: the ceiling."""
    size = 8192 if device.type == "cuda" else 512
    kind = torch.bfloat16 if how == "bfloat16" else torch.float32
    left, right = ((torch.rand(size, size, device=device) * 2 - 1).to(kind) for _ in range(2))

    def work() -> None:
        with products(how):
            left @ right

    work()
    return 2 * size**3 / least_of(work, device) / 1e12


def copy_rate(device: torch.device) -> float:
    """GB/s read and written by a large copy."""
    array = torch.rand(2**29 if device.type == "cuda" else 2**22, device=device)
    copy = torch.empty_like(array)
    return 2 * array.nbytes / least_of(lambda: copy.copy_(array), device) / 1e9
