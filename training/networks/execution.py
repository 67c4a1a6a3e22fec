"""How a network is run, never what it computes: precision of the wide products, compilation, and CUDA graphs."""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib.util
import os
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Literal, cast
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from datagen.common.errors import CompilerError
from training.networks.layers.surface import Surface


def sent(values: Tensor, device: torch.device) -> Tensor:
    """The same on a device, without waiting for it.

    A copy from ordinary memory to a GPU would wait until the GPU has done all that it was told before, a step's work.
    torch keeps the pinned memory until the copy is done.
    """
    return values.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else values.to(device)


Precision = Literal["float32", "tf32", "bfloat16", "float64"]


@contextlib.contextmanager
def precision(name: Precision, device: torch.device) -> Iterator[None]:
    """Run the block's wide matrix products in a precision; weights, norms, statistics and outputs stay float32.

    Parameters
    ----------
    name
        ``float32``: exact products; ``tf32``: products of 10-bit mantissas on GPUs that have them, exact elsewhere;
        ``bfloat16``: products of 8-bit mantissas, by autocast (the networks shield what does not bear it);
        ``float64``: as float32, for a caller who gives networks and meshes in float64.
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


def compiled(network: nn.Module, device: torch.device) -> nn.Module:
    """Return a network to call in place of `network`, for training or inference, whose operations torch.compile fuses.

    Both have the same parameters, buffers and parts, under the same names, so either may be trained, saved, loaded or
    wrapped for distributed training. The first call builds kernels for its vertex counts, the first call with others
    builds kernels for any; a backward pass and a precision have kernels of their own. That takes from seconds to
    minutes each time.

    Parameters
    ----------
    network
        Any network of `training.networks`; it stays as it is, to be called without kernels of its own.
    device
        Where it will run.

    Raises
    ------
    CompilerError
        This machine has no compiler for that device.
    """
    _require_compiler(device)
    twin = copy.copy(network)
    # Otherwise, in torch 2.13 on a CPU, a backward pass for any count expects the strides of the first one seen.
    twin.compile(options={"force_pointwise_cat": True})
    return twin


def _require_compiler(device: torch.device) -> None:
    if device.type == "cuda" and importlib.util.find_spec("triton") is None:
        raise CompilerError(
            "torch.compile needs the package triton on a GPU, and it is not installed. Install it "
            "(pip install triton), or do without: --set training.compile=false"
        )
    variable, language = ("CC", "C") if device.type == "cuda" else ("CXX", "C++")
    names = _compilers(variable)
    if not any(shutil.which(name) for name in names):
        raise CompilerError(
            f"torch.compile needs a {language} compiler on {device.type}, and there is no {' or '.join(names)} here. "
            f"Install one (Debian: apt-get install g++), name yours in {variable}, or do without: "
            "--set training.compile=false"
        )


def _compilers(variable: str) -> list[str]:
    """The compilers that torch (C++) and Triton (C) look for."""
    if os.environ.get(variable):
        return [os.environ[variable].split()[0]]
    if variable == "CC":
        return ["gcc", "clang"]
    return ["clang++" if sys.platform == "darwin" else "g++"]


class GraphedTransfer:
    """A network for inference that on a GPU replays recorded kernel launches for single pairs.

    For single pairs a GPU waits for Python most of the time; a CUDA graph takes that away. The first call of a shape is
    a plain one, the second records; from then on all launches go together. Larger batches, networks in training mode
    and a CPU are called plainly. The graphs belong to the network: every GraphedTransfer of it shares them, and they go
    when it goes. Calls from several threads wait for each other; on several streams at once there must be none, since
    inputs and output of a graph have one place in memory.

    Parameters
    ----------
    network
        Called as ``network(source=..., target=...)``; its weights may change and be replaced.
    precision
        See :func:`precision`; whatever autocast or TF32 setting surrounds the call has no effect.
    kept
        Shapes that are kept at most, the latest ones; each graph holds its own memory.
    """

    def __init__(self, network: nn.Module, *, precision: Precision = "float32", kept: int = 8) -> None:
        self._network, self._precision, self._kept = network, precision, kept

    @torch.no_grad()
    def __call__(self, *, source: Tensor, target: Tensor, **surfaces: Surface) -> Tensor:
        """Return ``[b, n_target, 3]`` for ``[b, n_source, 3]`` and ``[b, n_target, 3]``.

        With ``source_surface`` and ``target_surface``, for a network that takes them, nothing is replayed.

        Raises
        ------
        ValueError
            Source and target are on different devices, or the network refuses them.
        """
        if source.device != target.device:
            raise ValueError(f"source is on {source.device}, target on {target.device}")
        if source.device.type != "cuda" or len(source) != 1 or self._network.training or surfaces:
            return self._run(source, target, **surfaces)
        with _ONE_AT_A_TIME:
            graph = self._graph(source, target)
            return graph.replay(source, target) if graph else self._run(source, target)

    @property
    def recorded(self) -> int:
        """Graphs of the network that are recorded now."""
        return sum(graph is not None for graph in _GRAPHS.get(self._network, {}).values())

    def _graph(self, source: Tensor, target: Tensor) -> _Graph | None:
        """The graph of these shapes; None at their first call, which may be the only one."""
        graphs = _GRAPHS.setdefault(self._network, {})
        kind = self._kind(source, target)
        known = kind in graphs
        graph = graphs.pop(kind, None)
        if known and graph is None:
            with torch.cuda.device(source.device), torch.inference_mode(False), torch.no_grad():
                graph = _Graph(self._run, source, target)
        graphs[kind] = graph  # the latest is last
        while len(graphs) > self._kept:
            graphs.pop(next(iter(graphs)))
        return graph

    def _kind(self, source: Tensor, target: Tensor) -> tuple[object, ...]:
        """What a graph is good for. It reads the weights where they were: elsewhere in memory they need another."""
        weights = (*self._network.parameters(), *self._network.buffers())
        places = tuple(weight.data_ptr() for weight in weights)
        inputs = source.shape, target.shape, source.dtype, target.dtype, source.device
        return (self._precision, *inputs, places)

    def _run(self, source: Tensor, target: Tensor, **surfaces: Surface) -> Tensor:
        # without the cache of rounded weights: a graph would still read it after it is gone
        with products(self._precision), autocast(self._precision, source.device, cached=False):
            return cast(Tensor, self._network(source=source, target=target, **surfaces))


class _Graph:
    """One recorded call: inputs and output have fixed places in memory."""

    def __init__(self, run: Callable[[Tensor, Tensor], Tensor], source: Tensor, target: Tensor) -> None:
        self._source, self._target = source.clone(), target.clone()
        aside = _stream_aside(source.device)
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(3):  # libraries choose kernels and allocate in the first calls, which must not be recorded
                run(self._source, self._target)
        torch.cuda.current_stream().wait_stream(aside)
        self._graph = torch.cuda.CUDAGraph()
        # thread_local: what other threads do meanwhile, such as those that watch over NCCL, is no error
        with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
            self._output = run(self._source, self._target)

    def replay(self, source: Tensor, target: Tensor) -> Tensor:
        """The output for other inputs of the same shapes."""
        self._source.copy_(source)
        self._target.copy_(target)
        self._graph.replay()
        return self._output.clone()


@functools.cache
def _stream_aside(device: torch.device) -> torch.cuda.Stream:
    """One for all graphs: on each stream that it is called on, cuBLAS keeps memory of its own (32 MiB on an H200)."""
    return torch.cuda.Stream(device)  # type: ignore[no-untyped-call]


_GRAPHS: WeakKeyDictionary[nn.Module, dict[tuple[object, ...], _Graph | None]] = WeakKeyDictionary()
_ONE_AT_A_TIME = threading.Lock()
