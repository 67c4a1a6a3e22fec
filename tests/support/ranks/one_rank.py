"""DistributedDataParallel in this process alone: one rank, gloo, no port."""

import torch.distributed as dist
from torch import Tensor, nn


def two_backward_passes(network: nn.Module, inputs: dict[str, Tensor]) -> None:
    """Forward and backward twice: a parameter that got no gradient raises at the second forward."""
    dist.init_process_group("gloo", store=dist.HashStore(), rank=0, world_size=1)
    try:
        parallel = nn.parallel.DistributedDataParallel(network)
        for _ in range(2):
            parallel(**inputs).sum().backward()
    finally:
        # The wrapper must go before the group. Were it the last to hold the group, its end would wait for gloo's
        # threads with the interpreter's lock held, and one of those may be waiting for the lock.
        parallel = None
        dist.destroy_process_group()
