"""Correspondence learning of 3D-CoreNet: entropic optimal transport, without storing the matrices of its equations.

Shapes: ``b`` pairs of meshes, ``n`` vertices of the target, ``m`` of the source, ``d`` channels.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from training.networks.layers.modulation import full_precision

TEMPERATURE = 0.03
"""Entropic regularisation epsilon in ``K = exp(-(1 - C) / epsilon)`` (released code; so are the next two)."""

ITERATIONS = 5
"""Sinkhorn iterations."""

GUARD = 1e-8
"""Added to every denominator of an iteration."""

KEPT_ELEMENTS = 2**26
"""Up to this many elements (256 MiB of float32: 8,192 vertices each) ``K`` of a pair is kept between its iterations."""

BLOCK_ELEMENTS = 2**21
"""On a CPU, elements of ``K`` worked on at a time, so that a block is used twice while it is in cache."""

Masses = Tensor | None
"""Of vertices, ``[b, n, 1]`` and in sum one: a marginal of the transport; None: all the same."""


def warp(theta: Tensor, phi: Tensor, points: Tensor, targets: Masses = None, sources: Masses = None) -> Tensor:
    """Return, for every target vertex, the mean of the source's `points` under its row of the transport matrix.

    The same as ``transport_matrix(theta, phi, targets, sources) @ points``, but no ``n x m`` array survives the call.
    While it lasts, forward or backward, there is one, whatever the batch; or none, if it were larger than
    `KEPT_ELEMENTS`: blocks of its rows are then computed anew in each of the six passes over it.

    Parameters
    ----------
    theta, phi
        ``[b, n, d]`` and ``[b, m, d]``, features of unit length.
    points
        ``[b, m, 3]``.
    targets, sources
        Masses of the vertices, without a gradient.

    Returns
    -------
    Tensor
        ``[b, n, 3]``.
    """
    if torch.compiler.is_compiling():  # a compiler could not unroll an unknown number of blocks
        return transport_matrix(theta, phi, targets, sources) @ points
    return cast(Tensor, _Warp.apply(theta, phi, points, targets, sources))  # type: ignore[no-untyped-call]


def transport_matrix(theta: Tensor, phi: Tensor, targets: Masses = None, sources: Masses = None) -> Tensor:
    """Return the ``[b, n, m]`` transport between unit features ``[b, n, d]`` and ``[b, m, d]``; each row sums to one.

    The transport is ``diag(a) K diag(b)``. Its rows are divided by their sums, in which ``a`` cancels: the last update
    of ``a`` is not needed. Two such arrays are held at once if no gradient is wanted.
    """
    kernel = torch.bmm(theta, phi.transpose(1, 2)).sub_(1).div_(TEMPERATURE).exp_()
    rows, columns = _counts(theta, targets), _counts(phi, sources)
    left = 1 / rows
    right = _scaling(kernel.transpose(1, 2) @ left, columns)
    for _ in range(ITERATIONS - 1):
        left = _scaling(kernel @ right, rows)
        right = _scaling(kernel.transpose(1, 2) @ left, columns)
    unscaled = kernel * right.transpose(1, 2)
    total = kernel @ right
    return unscaled / total if unscaled.requires_grad else unscaled.div_(total)


def _counts(features: Tensor, masses: Masses) -> Tensor:
    """Return one over the marginals, ``[b, n, 1]``: of how many vertices, all of its mass, each would be one."""
    meshes, count, _ = features.shape
    return features.new_full((1, 1, 1), count).expand(meshes, count, 1) if masses is None else 1 / masses


def _scaling(sums: Tensor, counts: Tensor) -> Tensor:
    """Return the vector that brings rows (or columns) with these `sums`, ``[..., n, 1]``, to their marginals."""
    return 1 / (counts * (sums + GUARD))


class _Warp(torch.autograd.Function):
    """A pair of meshes at a time, so that memory does not grow with the batch; ``K`` is computed anew going back."""

    @staticmethod
    def forward(ctx: Any, theta: Tensor, phi: Tensor, points: Tensor, targets: Masses, sources: Masses) -> Tensor:
        counts = _counts(theta, targets), _counts(phi, sources)
        solved = [_solve(*pair) for pair in zip(theta, phi, points, zip(*counts, strict=True), strict=True)]
        mixed, left, right = (torch.stack(parts) for parts in zip(*solved, strict=True))
        ctx.save_for_backward(*counts, theta, phi, points, mixed, left, right)
        return mixed[..., :3] / mixed[..., 3:]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        with full_precision(gradient):  # whoever calls backward() may do so under autocast
            targets, sources, *solved = ctx.saved_tensors
            counts = zip(targets, sources, strict=True)
            found = [_gradients(*pair) for pair in zip(counts, *solved, gradient, strict=True)]
        theta, phi, points = zip(*found, strict=True)
        return torch.stack(theta), torch.stack(phi), torch.stack(points), None, None


class _Kernel:
    """``K`` of one pair of meshes, ``[n, m]``, by blocks of rows: kept if small, else computed whenever it is read."""

    def __init__(self, theta: Tensor, phi: Tensor) -> None:
        self.theta, self.phi = theta, phi
        self.shape = theta.shape[0], phi.shape[0]
        small = self.shape[0] * self.shape[1] <= KEPT_ELEMENTS
        length = BLOCK_ELEMENTS if theta.device.type == "cpu" else KEPT_ELEMENTS
        self.step = min(self.shape[0], max(1, length // self.shape[1]))
        self.kept = self.memory = theta.new_empty(self.shape[0] if small else self.step, self.shape[1])
        for rows in self._slices() if small else ():
            self._compute(rows, self.kept[rows])
        self.small = small

    def blocks(self) -> Iterator[tuple[slice, Tensor]]:
        """Give the blocks of rows in order, each with its place. A block is valid until the next is asked for."""
        for rows in self._slices():
            yield rows, self.kept[rows] if self.small else self._compute(rows, self.memory)

    def transposed_times(self, columns: Tensor) -> Tensor:
        """Return ``K^T @ columns`` for ``[n, k]``."""
        product = columns.new_zeros(self.shape[1], columns.shape[1])
        for rows, block in self.blocks():
            product.addmm_(block.t(), columns[rows])
        return product

    def _slices(self) -> Iterator[slice]:
        return (slice(start, start + self.step) for start in range(0, self.shape[0], self.step))

    def _compute(self, rows: slice, memory: Tensor) -> Tensor:
        part = self.theta[rows]
        block = memory[: part.shape[0]]
        return torch.mm(part, self.phi.t(), out=block).sub_(1).div_(TEMPERATURE).exp_()


def _solve(theta: Tensor, phi: Tensor, points: Tensor, counts: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return weighted sums of ``(x, y, z, 1)`` by row, ``[n, 4]``, and the scalings ``a`` and ``b`` of all iterations.

    One pass over ``K`` serves an update of ``a`` and the product for the next update of ``b``.
    """
    kernel, (targets, sources) = _Kernel(theta, phi), counts
    left = [1 / targets]
    right = [_scaling(kernel.transposed_times(left[0]), sources)]
    for _ in range(ITERATIONS - 1):
        totals, sums = theta.new_empty(theta.shape[0], 1), theta.new_zeros(phi.shape[0], 1)
        for rows, block in kernel.blocks():
            totals[rows] = block @ right[-1]
            sums.addmm_(block.t(), _scaling(totals[rows], targets[rows]))
        left.append(_scaling(totals, targets))
        right.append(_scaling(sums, sources))
    weighted, mixed = _homogeneous(points) * right[-1], theta.new_empty(theta.shape[0], 4)
    for rows, block in kernel.blocks():
        torch.mm(block, weighted, out=mixed[rows])
    return mixed, torch.cat(left, dim=1), torch.cat(right, dim=1)


def _gradients(
    counts: tuple[Tensor, Tensor],
    theta: Tensor,
    phi: Tensor,
    points: Tensor,
    mixed: Tensor,
    left: Tensor,
    right: Tensor,
    gradient: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of both features and of the points for the `gradient` of the warped points, ``[n, 3]``.

    Every iteration reads ``K`` through products with vectors, so the gradient of ``K`` is a sum of outer products: a
    matrix of rank 13 that is multiplied out a block at a time.
    """
    kernel, (targets, sources) = _Kernel(theta, phi), counts
    warped, total = mixed[:, :3] / mixed[:, 3:], mixed[:, 3:]
    grad_mixed = torch.cat([gradient, -(gradient * warped).sum(dim=1, keepdim=True)], dim=1) / total
    grad_weighted, vertices = kernel.transposed_times(grad_mixed), _homogeneous(points)
    grad_right = (grad_weighted * vertices).sum(dim=1, keepdim=True)
    rows_factor, columns_factor = [grad_mixed], [vertices * right[:, -1:]]
    for step in reversed(range(ITERATIONS)):
        grad_sums = -sources * grad_right * right[:, step : step + 1].square()
        rows_factor.append(left[:, step : step + 1])
        columns_factor.append(grad_sums)
        if step > 0:  # the first `a` is a constant
            slope = -targets * left[:, step : step + 1].square()
            grad_totals, grad_right = _there_and_back(kernel, grad_sums, slope)
            rows_factor.append(grad_totals)
            columns_factor.append(right[:, step - 1 : step])
    grad_theta, grad_phi = _feature_gradients(kernel, torch.cat(rows_factor, dim=1), torch.cat(columns_factor, dim=1))
    return grad_theta, grad_phi, grad_weighted[:, :3] * right[:, -1:]


def _there_and_back(kernel: _Kernel, column: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``t = (K @ column) * slope`` and ``K^T @ t`` in one pass over ``K``."""
    there, back = torch.empty_like(slope), torch.zeros_like(column)
    for rows, block in kernel.blocks():
        there[rows] = (block @ column) * slope[rows]
        back.addmm_(block.t(), there[rows])
    return there, back


def _feature_gradients(kernel: _Kernel, rows_factor: Tensor, columns_factor: Tensor) -> tuple[Tensor, Tensor]:
    grad_theta, grad_phi = torch.empty_like(kernel.theta), torch.zeros_like(kernel.phi)
    for rows, block in kernel.blocks():
        grad_cosine = torch.mm(rows_factor[rows], columns_factor.t()).mul_(block).div_(TEMPERATURE)
        torch.mm(grad_cosine, kernel.phi, out=grad_theta[rows])
        grad_phi.addmm_(grad_cosine.t(), kernel.theta[rows])
    return grad_theta, grad_phi


def _homogeneous(points: Tensor) -> Tensor:
    return torch.nn.functional.pad(points, (0, 1), value=1.0)
