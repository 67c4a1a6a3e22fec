"""The pose encoder that DSFFNet and NPT share: one vector a mesh, whatever the number and order of its vertices."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from training.networks.layers.modulation import VARIANCE_FLOOR, full_precision, total_mass, vertex_mean

ARGMAX_ELEMENTS = 2**20
"""On a CPU, elements of the last layer held at a time while its largest values are searched, to stay in cache."""

ARGMAX_ELEMENTS_ELSEWHERE = 2**28
"""The same on a GPU, where a few large products are better than many thin ones."""


class PoseEncoder(nn.Module):
    """Linear layer, instance norm and ReLU, a width at a time, then the maximum over the vertices.

    The vertices count in the norms by their masses ``[b, n, 1]``, in sum one; None: equally.

    Parameters
    ----------
    widths
        Channels after each layer; the last is the length of the pose vector.
    """

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in zip((3, *widths), widths, strict=False))

    @property
    def last(self) -> nn.Linear:
        """The layer that gives the pose vector's channels."""
        return self.linear_layers()[-1]

    def linear_layers(self) -> list[nn.Linear]:
        """Return the layers in order; their biases have no effect, since a norm follows each."""
        return [cast(nn.Linear, layer) for layer in self.layers]

    def forward(self, source: Tensor, masses: Tensor | None = None) -> Tensor:
        """Return ``[b, widths[-1]]`` for ``[b, n, 3]``."""
        last = self.last.weight
        searched = _search_precision(source)  # asked before autocast is switched off
        with full_precision(source):
            centred = self._before_last(source, masses)
            return torch.relu(_largest(last, centred, searched) * deviation_after(last, centred, masses))

    def features(self, source: Tensor, masses: Tensor | None = None) -> Tensor:
        """Return ``[b, n, widths[-1]]``, of which `forward` is the maximum over the vertices."""
        with full_precision(source):
            centred = self._before_last(source, masses)
            line = normalised_linear(self.last.weight, centred, masses)
        return torch.relu(centred @ line)

    def _before_last(self, source: Tensor, masses: Tensor | None) -> Tensor:
        centred = centred_features(source, masses)
        for layer in self.linear_layers()[:-1]:
            line = normalised_linear(layer.weight, centred, masses)
            centred = centred_features(torch.relu(centred @ line), masses)
        return centred


def centred_features(features: Tensor, masses: Tensor | None = None) -> Tensor:
    """Return ``[b, n, i]`` features less their mean over the vertices."""
    return features - vertex_mean(features, masses)


def deviation_after(weight: Tensor, centred: Tensor, masses: Tensor | None = None) -> Tensor:
    """Return ``1 / sqrt(Var + eps)`` of the features ``weight @ x`` without computing these features.

    The variance of ``w . x`` is ``w' Cov(x) w``. The covariance is taken in float64: in float32 a channel whose
    variance is a millionth of its neighbours' would be lost in rounding.

    Parameters
    ----------
    weight
        ``[c, i]``.
    centred
        ``[b, n, i]``, with zero mean over the vertices.
    masses
        ``[b, n, 1]``, how much each vertex counts, in sum one; None: equally.

    Returns
    -------
    Tensor
        ``[b, c]``, in the dtype of `centred`.
    """
    if torch.compiler.is_compiling():
        variance = _variance_after(weight, centred, masses)[0]
    else:
        variance = cast(Tensor, _VarianceAfter.apply(weight, centred, masses))  # type: ignore[no-untyped-call]
    return torch.rsqrt(variance + VARIANCE_FLOOR)


def normalised_linear(weight: Tensor, centred: Tensor, masses: Tensor | None = None) -> Tensor:
    """Return the ``[b, i, c]`` maps ``m`` for which ``centred @ m`` is the instance norm of ``weight @ x + bias``.

    A bias shifts the mean that the norm removes, so it has no part in this.
    """
    return weight.t() * deviation_after(weight, centred, masses).unsqueeze(1)


def _variance_after(weight: Tensor, centred: Tensor, masses: Tensor | None) -> tuple[Tensor, Tensor]:
    precise, rows = centred.double(), weight.double()
    weighted = precise if masses is None else precise * masses
    images = rows @ (precise.transpose(1, 2) @ weighted / total_mass(centred, masses))
    return (images * rows).sum(dim=2).to(centred.dtype), images.to(centred.dtype)


class _VarianceAfter(torch.autograd.Function):
    """Going back, the covariance is symmetric: one product, in the working precision, instead of two in float64."""

    @staticmethod
    def forward(ctx: Any, weight: Tensor, centred: Tensor, masses: Tensor | None) -> Tensor:
        variance, images = _variance_after(weight, centred, masses)
        ctx.save_for_backward(weight, centred, images, masses)
        return variance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor | None, None]:
        weight, centred, images, masses = ctx.saved_tensors
        weighted = 2 * gradient.unsqueeze(2)
        grad_centred = None
        if ctx.needs_input_grad[1]:
            grad_centred = centred @ (weight.t() @ (weighted / total_mass(centred, masses) * weight))
            grad_centred = grad_centred if masses is None else grad_centred.mul_(masses)
        return (weighted * images).sum(dim=0), grad_centred, None


def _search_precision(features: Tensor) -> torch.dtype:
    """Return the dtype of products that only decide which is the largest: the ambient autocast's, if there is one."""
    device = features.device.type
    if features.dtype == torch.float32 and torch.is_autocast_enabled(device):
        return torch.get_autocast_dtype(device)
    return features.dtype


def _largest(weight: Tensor, features: Tensor, searched: torch.dtype) -> Tensor:
    """Return the maximum over the vertices of ``weight @ features``, ``[b, c]``, a few channels at a time.

    Products in the dtype `searched` decide which vertex is the largest; the value there is exact in any case.
    """
    meshes = features.shape[0]
    with torch.no_grad():
        rows, columns = weight.to(searched), features.transpose(1, 2).to(searched)
        parts = [rows] if torch.compiler.is_compiling() else _parts(rows, meshes * features.shape[1])
        # max, not argmax, which takes six times as long on a CPU
        index = torch.cat([torch.bmm(part.expand(meshes, -1, -1), columns).max(dim=2).indices for part in parts], dim=1)
    mesh = torch.arange(meshes, device=features.device).unsqueeze(1)
    # Indexing, not gather: its derivative is deterministic on a GPU too.
    return (features[mesh, index] * weight).sum(dim=2)


def _parts(weight: Tensor, columns: int) -> list[Tensor]:
    elements = ARGMAX_ELEMENTS if weight.device.type == "cpu" else ARGMAX_ELEMENTS_ELSEWHERE
    rows = max(1, elements // columns)
    return [weight[start : start + rows] for start in range(0, weight.shape[0], rows)]
