"""What the parts network learns from: the pose given to the target, and what a rig says of both meshes.

The DSFFNet paper's networks learn from vertices alone; weights, joints and rotations are supervision beyond that.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from training.networks.layers.modulation import full_precision
from training.networks.layers.surface import Surface
from training.networks.parts import Parts, Reading, boxed

_REST, _WEIGHTS, _ROTATIONS, _JOINTS = 5.0, 0.1, 0.12, 0.04
_SMALL_TURN, _SMALL_STEP = 0.05, 0.005
"""Of rotations (Frobenius' norm; two degrees) and joints (half the longest edge of the box being 1), distances up to
which they count as their squares do, larger ones as themselves: by squares alone the hardest poses would count most.
"""


@dataclass(frozen=True)
class Posed:
    """How some meshes are posed, for the vertices that a step takes of them.

    Attributes
    ----------
    weights
        Skinning weights [b, n, part].
    rest, rest_joints
        Vertices [b, n, 3] and joints [b, part, 3] in the poses' rest pose, from the root joint, half the body's longest
        edge being 1.
    rotations, joints
        Of the parts [b, part, 3, 3], relative to rest, and [b, part, 3], both in the mesh' axes, these in its box.
    present
        Whether the body has the part [b, part], 0 or 1: of one that it lacks nothing is to be learned.
    """

    weights: Tensor
    rest: Tensor
    rest_joints: Tensor
    rotations: Tensor
    joints: Tensor
    present: Tensor

    def in_dtype(self, dtype: torch.dtype) -> Posed:
        """The same in another floating type."""
        return self.to(dtype)

    def to(self, place: torch.dtype | torch.device | str) -> Posed:
        """The same in another floating type, or on another device."""
        return replace(self, **{field.name: getattr(self, field.name).to(place) for field in fields(self)})


def parts_loss(
    network: Parts,
    *,
    source: Tensor,
    target: Tensor,
    truth: Tensor,
    posed: tuple[Posed, Posed],
    surfaces: tuple[Surface, Surface] | None = None,
    at_rest: bool = False,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the weighted loss and its parts, detached, and unweighted but for ``at_rest``.

    ``reconstruction`` is that of the papers, output and truth in boxes of the vertices that are there; the others are
    means over both meshes: ``weights``, the cross-entropy of a vertex's part; ``rest``, squared distances; ``rotation``
    and ``joint``, distances that are smooth near zero (Charbonnier et al. 1994). ``at_rest`` is the weighted sum of
    those four where the meshes are read again (`Parts.read_again`).

    Parameters
    ----------
    source, target, truth
        ``[b, n, 3]``.
    posed
        How the sources and the targets are posed.
    surfaces
        What is near along their surfaces; None: it is not told.
    at_rest
        Whether the meshes are read again, as what was read poses them to rest; no gradient reaches the first reading
        by it. They are sampled anew there, which transfers do not do.
    """
    with full_precision(source):
        readings = network.read_pair(source, target, surfaces)
        output = network.posed_like(target, readings)
    reconstruction = 3 * mse_loss(output, boxed(truth))
    named = _compared(readings, posed)
    loss = reconstruction + 2 * _weighted(named)
    if at_rest:
        with full_precision(source):
            meshes, posed = _posed_to_rest(network, (source, target), readings, posed)
            readings = network.read_pair(*meshes, surfaces)
        named["at_rest"] = _weighted(_compared(readings, posed))
        loss = loss + 2 * named["at_rest"]
    return loss, {name: value.detach() for name, value in {"reconstruction": reconstruction, **named}.items()}


@torch.no_grad()
def _posed_to_rest(
    network: Parts, meshes: tuple[Tensor, Tensor], readings: tuple[Reading, Reading], posed: tuple[Posed, Posed]
) -> tuple[tuple[Tensor, Tensor], tuple[Posed, Posed]]:
    """Both meshes [b, n, 3] as their readings pose them to rest, and what of rotations and joints is missing there.

    What was read rightly is at rest then; a part that was misread is turned by what is missing. A joint lies on two
    parts, and what was missed of it goes along with both, by halves. Vertices follow all parts that they are taken
    for, near or not, as what is near is asked outside of training alone.
    """
    found = list[tuple[Tensor, Posed]]()
    for vertices, reading, right in zip(meshes, readings, posed, strict=True):
        rest, back = network.posed_to_rest(vertices, reading), reading.rotations.mT
        both = (back + back[:, network.parents]) / 2
        joints = rest.joints + (both @ (right.joints - reading.joints)[..., None])[..., 0]
        joints = (joints - rest.middle) / rest.half
        found.append((rest.vertices, replace(right, rotations=back @ right.rotations, joints=joints)))
    of_source, of_target = found
    return (of_source[0], of_target[0]), (of_source[1], of_target[1])


def _weighted(named: dict[str, Tensor]) -> Tensor:
    """The sum of what was compared, each by its weight."""
    return (
        _REST * named["rest"] + _WEIGHTS * named["weights"] + _ROTATIONS * named["rotation"] + _JOINTS * named["joint"]
    )


def _compared(readings: tuple[Reading, Reading], posed: tuple[Posed, Posed]) -> dict[str, Tensor]:
    """Means over both meshes."""
    of_source, of_target = (_compared_with(reading, right) for reading, right in zip(readings, posed, strict=True))
    return {name: (value + of_target[name]) / 2 for name, value in of_source.items()}


def _compared_with(reading: Reading, right: Posed) -> dict[str, Tensor]:
    there = right.present / right.present.sum(1, keepdim=True)
    turned = (reading.rotations - right.rotations).square().sum((2, 3))
    away = (reading.joints - right.joints).square().sum(2)
    return {
        "weights": -(right.weights * reading.logits.log_softmax(2)).sum(2).mean(),
        "rest": (reading.rest - right.rest).square().sum(2).mean(),
        "rotation": (_distance(turned, _SMALL_TURN) * there).sum(1).mean(),
        "joint": (_distance(away, _SMALL_STEP) * there).sum(1).mean(),
    }


def _distance(squared: Tensor, small: float) -> Tensor:
    """Distances [...] by their squares [...]; below ``small`` they grow as squares do (Charbonnier et al. 1994)."""
    return (squared + small**2).sqrt() - small
