"""Muon: steps of matrices along the orthogonal matrix that is nearest to their momentum; AdamW of all else."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
import torch.distributed as dist
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
    Ranks share the work, which in narrow networks is half of a training step: gradients are the same on all, so that
    each finds the steps of some matrices, and all get them.

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
        rank: int = 0,
        ranks: int = 1,
    ) -> None:
        given = list(parameters)
        groups = [{"params": [each for each in given if _is_matrix(each) == kind]} for kind in (True, False)]
        super().__init__(groups, lr=lr, betas=betas, eps=eps, weight_decay=weight_decay, fused=True)
        self._rank, self._ranks = rank, ranks

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
        if not matrices:
            return
        group, bad = self.param_groups[0], getattr(self, "found_inf", None)
        for parameter in matrices:
            if not self.state[parameter]:
                # AdamW, whose class this is, asks every state for a step when it is loaded
                self.state[parameter].update(step=torch.zeros(()), momentum=torch.zeros_like(parameter))
        momenta = [self.state[parameter]["momentum"] for parameter in matrices]
        if bad is not None:  # then it stays as it is
            pairs = zip(momenta, gradients, strict=True)
            gradients = [torch.where(bad > 0, momentum, gradient) for momentum, gradient in pairs]
        torch._foreach_lerp_(momenta, gradients, 1 - _MOMENTUM)
        ahead = torch._foreach_lerp(gradients, momenta, _MOMENTUM)  # Nesterov's
        steps = self._directions([each.flatten(1) for each in ahead])
        sizes: list[Any] = [group["lr"] * _SHARE_OF_ADAM * max(step.shape) ** 0.5 for step in steps]
        torch._foreach_mul_(steps, sizes)
        decay: Any = group["lr"] * group["weight_decay"]
        if bad is not None:
            torch._foreach_mul_(steps, 1 - bad)
            decay = (1 - bad) * decay
        own: list[Tensor] = [*matrices]
        torch._foreach_mul_(own, 1 - decay)
        torch._foreach_sub_(own, [step.view_as(its) for step, its in zip(steps, matrices, strict=True)])

    def _directions(self, matrices: Sequence[Tensor]) -> list[Tensor]:
        """The orthogonal matrix nearest to each, those of one shape together; ranks share them by their cost."""
        loads, mine = [0] * self._ranks, defaultdict(list)
        for number in sorted(range(len(matrices)), key=lambda number: -_cost(matrices[number])):
            owner = loads.index(min(loads))
            loads[owner] += _cost(matrices[number])
            if owner == self._rank:
                mine[matrices[number].shape].append(number)
        found = matrices[0].new_zeros(sum(map(Tensor.numel, matrices)))
        pieces = torch.split(found, [each.numel() for each in matrices])
        steps = [piece.view_as(each) for piece, each in zip(pieces, matrices, strict=True)]
        for numbers in mine.values():
            own = orthogonal(torch.stack([matrices[number] for number in numbers]))
            torch._foreach_copy_([steps[number] for number in numbers], list(own.unbind()))
        if self._ranks > 1:
            dist.all_reduce(found)  # others have zeros there
        return steps


def _cost(matrix: Tensor) -> int:
    return matrix.numel() * min(matrix.shape)


def orthogonal(matrices: Tensor) -> Tensor:
    """Return nearly U V^T of matrices U S V^T [m, row, column]: singular values of 0.7 to 1.2 (Newton and Schulz)."""
    wide = matrices if matrices.shape[1] <= matrices.shape[2] else matrices.mT
    wide = wide / wide.norm(dim=(1, 2), keepdim=True).clamp_min(1e-12)
    for a, b, c in _ITERATIONS:
        squares = wide @ wide.mT
        wide = torch.baddbmm(wide, torch.baddbmm(squares, squares, squares, beta=b, alpha=c), wide, beta=a)
    return wide if matrices.shape[1] <= matrices.shape[2] else wide.mT


def _is_matrix(parameter: Tensor) -> bool:
    return parameter.ndim >= 2 and min(len(parameter), parameter.numel() // max(1, len(parameter))) >= _FEWEST
