"""How a network is run, never what it computes: precision of the wide products, and CUDA graphs."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Literal, cast

import torch
from torch import Tensor, nn

Precision = Literal["float32", "tf32", "bfloat16"]


@contextlib.contextmanager
def precision(name: Precision, device: torch.device) -> Iterator[None]:
    """Run the block's wide matrix products in a precision; weights, norms, statistics and outputs stay float32.

    Parameters
    ----------
    name
        ``float32``: exact products; ``tf32``: products of 10-bit mantissas on GPUs that have them, exact elsewhere;
        ``bfloat16``: products of 8-bit mantissas, by autocast (the networks shield what does not bear it).
    device
        Where the block runs.
    """
    with products(name), autocast(name, device):
        yield


@contextlib.contextmanager
def products(name: Precision) -> Iterator[None]:
    """Whether float32 products may use TF32, in the block and in a backward pass within it."""
    before = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
    torch.set_float32_matmul_precision("high" if name == "tf32" else "highest")
    torch.backends.cudnn.allow_tf32 = name == "tf32"
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before[0])
        torch.backends.cudnn.allow_tf32 = before[1]


def autocast(name: Precision, device: torch.device, *, cached: bool = True) -> torch.autocast:
    """Autocast for a forward pass; its backward pass runs outside, in the same precisions."""
    return torch.autocast(device.type, torch.bfloat16, enabled=name == "bfloat16", cache_enabled=cached)


class GraphedTransfer:
    """A network for inference whose kernel launches are recorded once for each shape and then replayed together.

    For single pairs a GPU waits for Python most of the time; a CUDA graph takes that away. On a CPU the network is
    simply called. Not for several threads or streams at once: inputs and output of a graph have one place in memory.

    Parameters
    ----------
    network
        Called as ``network(source=..., target=...)``; its weights may change in place, not be replaced.
    precision
        See :func:`precision`.
    kept
        Shapes whose graphs are kept; each holds its own memory.
    """

    def __init__(self, network: nn.Module, *, precision: Precision = "float32", kept: int = 8) -> None:
        self._network, self._precision, self._kept = network.eval(), precision, kept
        self._graphs: dict[tuple[object, ...], _Graph] = {}

    @torch.no_grad()
    def __call__(self, *, source: Tensor, target: Tensor) -> Tensor:
        """Return ``[b, n_target, 3]`` for ``[b, n_source, 3]`` and ``[b, n_target, 3]``."""
        if source.device.type != "cuda":
            return self._run(source, target)
        if source.device != target.device:
            raise ValueError(f"source is on {source.device}, target on {target.device}")
        kind = (source.shape, target.shape, source.dtype, target.dtype, source.device)
        graph = self._graphs.pop(kind, None)
        if graph is None:
            with torch.cuda.device(source.device), torch.inference_mode(False):
                graph = _Graph(self._run, source, target)
        self._graphs[kind] = graph  # the latest is last
        while len(self._graphs) > self._kept:
            self._graphs.pop(next(iter(self._graphs)))
        return graph.replay(source, target)

    def _run(self, source: Tensor, target: Tensor) -> Tensor:
        # without the cache of rounded weights: a graph would go on reading it after it is gone
        with products(self._precision), autocast(self._precision, source.device, cached=False):
            return cast(Tensor, self._network(source=source, target=target))


class _Graph:
    """One recorded call: inputs and output have fixed places in memory."""

    def __init__(self, run: object, source: Tensor, target: Tensor) -> None:
        assert callable(run)
        self._source, self._target = source.clone(), target.clone()
        aside = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(
                3
            ):  # libraries choose their kernels and allocate in the first calls, which must not be recorded
                run(self._source, self._target)
        torch.cuda.current_stream().wait_stream(aside)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._output = run(self._source, self._target)

    def replay(self, source: Tensor, target: Tensor) -> Tensor:
        self._source.copy_(source)
        self._target.copy_(target)
        self._graph.replay()
        return cast(Tensor, self._output.clone())
