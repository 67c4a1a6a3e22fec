"""Small tensors on their way to a device."""

import torch
from torch import Tensor


def sent(values: Tensor, device: torch.device) -> Tensor:
    """The same on a device, without waiting for it.

    A copy from ordinary memory to a GPU would wait until the GPU has done all that it was told before, a step's work.
    torch keeps the pinned memory until the copy is done.
    """
    return values.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else values.to(device)
