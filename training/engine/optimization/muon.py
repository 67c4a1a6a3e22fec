"""Muon: steps of matrices along the orthogonal matrix that is nearest to their momentum; AdamW of all else."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

_MOMENTUM = 0.95
_FEWEST = 32
"""Rows and columns of what counts as a matrix; layers from or to a few channels, as coordinates are, do not."""
_SHARE_OF_ADAM = 0.2
"""Root mean square of a step of AdamW at a learning rate of 1 (Liu et al. 2025, section 2.2): both share one."""
_ITERATIONS = ((3.4445, -4.7750, 2.0315),) * 5


class Muon(torch.optim.AdamW):
    """Muon (Jordan et al. 2024), at AdamW's learning rates and weight decay (Liu et al. 2025, equation 4).

    PyTorch's own takes matrices alone, one at a time and in bfloat16, which many CPUs have not; here those of one shape
    go together, in their own precision. A parameter of more than two axes is the matrix of its first by the others.

    Parameters
    ----------
    parameters
        Matrices of at least 32 rows and columns, and others.
    lr, betas, eps, weight_decay
        AdamW's; the betas and eps are of the others alone.
    """

    def __init__(
        self,
        parameters: Iterable[nn.Parameter],
        *,
        lr: float,
        betas: tuple[float, float],
        eps: float,
        weight_decay: float,
    ) -> None:
        given = list(parameters)
        groups = [{"params": [each for each in given if _is_matrix(each) == kind]} for kind in (True, False)]
        super().__init__(groups, lr=lr, betas=betas, eps=eps, weight_decay=weight_decay, fused=True)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]
        """Move all parameters that have gradients, unless ``found_inf`` is set and not zero."""
        assert closure is None, "a closure would compute gradients anew"
        matrices = [each for each in self.param_groups[0]["params"] if each.grad is not None]
        gradients = [each.grad for each in matrices]
        self._move(matrices, gradients)
        for each in matrices:
            each.grad = None  # AdamW leaves out what has none
        super().step()
        for each, gradient in zip(matrices, gradients, strict=True):
            each.grad = gradient

    def _move(self, matrices: list[nn.Parameter], gradients: list[Tensor]) -> None:
        group, bad = self.param_groups[0], getattr(self, "found_inf", None)
        alike: dict[tuple[int, int], list[tuple[nn.Parameter, Tensor]]] = defaultdict(list)
        for parameter, own in zip(matrices, gradients, strict=True):
            state = self.state[parameter]
            if not state:
                # AdamW, whose class this is, asks every state for a step when it is loaded
                state.update(step=torch.zeros(()), momentum=torch.zeros_like(parameter))
            gradient = own if bad is None else own.masked_fill(bad > 0, 0)
            state["momentum"].lerp_(gradient, (1 - _MOMENTUM) * (1 if bad is None else 1 - bad))
            ahead = gradient.lerp(state["momentum"], _MOMENTUM).flatten(1)  # Nesterov's
            alike[ahead.shape[0], ahead.shape[1]].append((parameter, ahead))
        moved = torch.tensor(1.0) if bad is None else 1 - bad
        for (rows, columns), some in alike.items():
            size = group["lr"] * _SHARE_OF_ADAM * max(rows, columns) ** 0.5
            for (parameter, _), step in zip(some, orthogonal(torch.stack([own for _, own in some])), strict=True):
                parameter.mul_(1 - moved * group["lr"] * group["weight_decay"])
                parameter.sub_(step.view_as(parameter) * (size * moved))


def orthogonal(matrices: Tensor) -> Tensor:
    """Return nearly U V^T of matrices U S V^T [m, row, column]: singular values of 0.7 to 1.2 (Newton and Schulz)."""
    wide = matrices if matrices.shape[1] <= matrices.shape[2] else matrices.mT
    wide = wide / wide.norm(dim=(1, 2), keepdim=True).clamp_min(1e-12)
    for a, b, c in _ITERATIONS:
        squares = wide @ wide.mT
        wide = a * wide + (b * squares + c * squares @ squares) @ wide
    return wide if matrices.shape[1] <= matrices.shape[2] else wide.mT


def _is_matrix(parameter: Tensor) -> bool:
    return parameter.ndim >= 2 and min(len(parameter), parameter.numel() // max(1, len(parameter))) >= _FEWEST
