"""Bodies of other proportions than a dataset's, made from what its rigs say: larger heads, shorter legs."""

from collections.abc import Mapping
from dataclasses import fields, replace

import torch
from torch import Tensor

from datagen.characters.joint_names import pairs
from training.data.batch import Batch
from training.data.row_random import Purpose, RowRandom
from training.networks.execution import sent
from training.networks.layers.rigid_parts import ancestors, box, moved_joints, skinned
from training.objectives.parts import Posed


def of_other_proportions(batch: Batch, deviation: float, joints: Mapping[str, str | None], random: RowRandom) -> Batch:
    """Half of the triples, by chance, with parts that are larger and smaller, left and right alike, posed by skinning.

    Parameters
    ----------
    batch
        Told of its rigs.
    joints
        Of the network, each with its parent's name.
    """
    assert batch.posed is not None
    names, device = list(joints), batch.source.device
    parents = [-1 if parent is None else names.index(parent) for parent in joints.values()]
    tree = sent(torch.tensor([part if own < 0 else own for part, own in enumerate(parents)]), device)
    above, alike = sent(ancestors(parents), device), list(range(len(names)))
    for left, right in pairs(names):
        alike[right] = left
    drawn = random.normal(Purpose.PROPORTIONS, 2, len(names))
    chosen = random.uniform(Purpose.RESIZED) < 0.5
    sizes = torch.exp(deviation * drawn.index_select(2, sent(torch.tensor(alike), device))).to(batch.source.dtype)
    bodies = [
        _resized(posed, factors, tree, above) for posed, factors in zip(batch.posed, sizes.unbind(1), strict=True)
    ]
    of_source, of_target = bodies
    source, of_source = _placed(of_source, of_source.rotations, tree, above)
    truth, _ = _placed(of_target, of_source.rotations, tree, above)
    target, of_target = _placed(of_target, of_target.rotations, tree, above)
    return replace(
        batch,
        source=_where(chosen, source, batch.source),
        target=_where(chosen, target, batch.target),
        truth=_where(chosen, truth, batch.truth),
        posed=(_either(chosen, of_source, batch.posed[0]), _either(chosen, of_target, batch.posed[1])),
    )


def _resized(posed: Posed, sizes: Tensor, parents: Tensor, above: Tensor) -> Posed:
    """The body at rest with each part made larger by its own factor [b, part], and so the bones that it carries."""
    still = sizes[:, :, None, None] * torch.eye(3, dtype=sizes.dtype, device=sizes.device)
    joints = moved_joints(posed.rest_joints, still, parents, above)
    rest = skinned(posed.rest, posed.weights, still, posed.rest_joints, joints)
    times = box(rest)[1] / box(posed.rest)[1]  # by the vertices that are taken: nearly that of all
    return replace(posed, rest=rest / times, rest_joints=joints / times)


def _placed(posed: Posed, rotations: Tensor, parents: Tensor, above: Tensor) -> tuple[Tensor, Posed]:
    """The body's vertices [b, n, 3] with its parts turned so, in the box of those that are taken, and its joints."""
    joints = moved_joints(posed.rest_joints, rotations, parents, above)
    vertices = skinned(posed.rest, posed.weights, rotations, posed.rest_joints, joints)
    middle, half = box(vertices)
    return (vertices - middle) / half, replace(posed, rotations=rotations, joints=(joints - middle) / half)


def _either(chosen: Tensor, one: Posed, other: Posed) -> Posed:
    names = [field.name for field in fields(Posed)]
    return Posed(**{name: _where(chosen, getattr(one, name), getattr(other, name)) for name in names})


def _where(chosen: Tensor, one: Tensor, other: Tensor) -> Tensor:
    return torch.where(chosen.reshape(-1, *[1] * (one.ndim - 1)), one, other)
