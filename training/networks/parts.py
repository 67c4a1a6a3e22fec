"""The parts network: it reads off a mesh which part each vertex belongs to and how the parts are turned.

Unlike the networks of the papers it moves no vertex by itself. Both meshes are read by the same weights: skinning
weights of every vertex, rotations and joints of the parts, and where each vertex lies on the body at rest. Then the
target's parts are turned as the source's are, its skeleton takes its joints along, and its vertices follow by linear
blend skinning. That is learned from what the papers' networks are not told: weights, joints and rotations of bodies
that have a rig (:mod:`training.objectives.parts`). Where faces are known, vertices hear only of what is near along the
surface (:mod:`training.networks.layers.surface`), so that a hand on a thigh is not taken for the thigh's; and they
follow no part that is not near so, nor one that does not hang there on the root.

    read(source), read(target) -> turns D_k = R_k(source) R_k(target)^T -> joints -> vertices, in their own box

Outside of training each mesh is read twice, as it is and at rest, and so is the output, by which turns are corrected.

No scale is taken from the source, so that missing vertices of it do not matter to the size of the output.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from training.networks.layers.input_checks import check_pair
from training.networks.layers.modulation import full_precision
from training.networks.layers.rigid_parts import (
    ancestors,
    box,
    halved,
    hanging_on,
    matrices,
    mirrored,
    moved_joints,
    nearest_rotations,
    other_side,
    rotations_from_six,
    skinned,
)
from training.networks.layers.sampling import Sample, Surroundings, others, sample, taken
from training.networks.layers.surface import Surface, joined
from training.recipes.networks import PEOPLE

_VARIANCE_FLOOR = 1e-5
_LEAST_NEAR, _LEAST_HOLDING = 0.07, 0.25
"""Share of a part's surface that has to lie near a vertex, along the surface, for the vertex to follow the part; and
how much of one has to lie near a place, of the most that lies near any, for others to hang on it there
(docs/results/parts-experiments.md)."""
_STEPS = 8
"""At least so many, from place to place and part to part, are gone from the root over the body."""


class Reading(NamedTuple):
    """What the network reads off meshes.

    Attributes
    ----------
    logits
        Of the part of each vertex [b, n, part].
    rest
        Where each vertex lies on the body at rest [b, n, 3]: from the root joint, half the box' longest edge being 1.
    rotations, joints
        Of the parts, [b, part, 3, 3] relative to rest and [b, part, 3], in the mesh' own axes and box.
    """

    logits: Tensor
    rest: Tensor
    rotations: Tensor
    joints: Tensor


class ReadTarget(NamedTuple):
    """What was read off targets (:meth:`Parts.read_target`).

    Attributes
    ----------
    vertices, as_read
        [b, n, 3], what is posed, and where it was read.
    drawn
        The sample of what was read.
    weights
        By which vertices are posed [b, n, part].
    rotations, joints
        As in :class:`Reading`.
    """

    vertices: Tensor
    as_read: Tensor
    drawn: Sample
    weights: Tensor
    rotations: Tensor
    joints: Tensor


class AtRest(NamedTuple):
    """Meshes that a reading posed to rest (:meth:`Parts.posed_to_rest`).

    Attributes
    ----------
    vertices
        [b, n, 3], in boxes of their own.
    joints
        Where the joints that were read [b, part, 3] went, before those boxes were taken.
    middle, half
        Of the boxes, [b, 1, 3] and [b, 1, 1].
    """

    vertices: Tensor
    joints: Tensor
    middle: Tensor
    half: Tensor


class Parts(nn.Module):
    """The parts network.

    Parameters
    ----------
    joints
        Names of the joints that turn the parts, each with its parent's; a root has none. A parent comes first.
    width
        Channels of the vertices' features.
    token_width
        Channels of the parts' tokens, a multiple of 4.
    blocks
        Layers of attention between the parts.

    Examples
    --------
    >>> network = Parts(joints={"pelvis": None, "head": "pelvis"}, width=8, token_width=8, blocks=1)
    >>> network(source=torch.rand(2, 50, 3), target=torch.rand(2, 30, 3)).shape
    torch.Size([2, 30, 3])
    """

    takes_surfaces = True
    parents: Tensor
    above: Tensor
    hangs_on: Tensor
    other_side: Tensor | None
    upright: Tensor

    def __init__(
        self, *, joints: Mapping[str, str | None] = PEOPLE, width: int = 128, token_width: int = 96, blocks: int = 3
    ) -> None:
        super().__init__()
        self.joints = tuple(joints)
        parents = [-1 if parent is None else self.joints.index(parent) for parent in joints.values()]
        if not joints or any(parent >= part for part, parent in enumerate(parents)):
            raise ValueError(f"joints must name a tree, each parent before its children, got {dict(joints)}")
        if token_width % _HEADS:
            raise ValueError(f"token_width must be a multiple of {_HEADS}, got {token_width}")
        own = [part if parent < 0 else parent for part, parent in enumerate(parents)]
        self.register_buffer("parents", torch.tensor(own), persistent=False)
        self.register_buffer("above", ancestors(parents), persistent=False)
        self._steps = max(_STEPS, int(self.above.sum(1).max()) - 1)  # the depth of the tree
        self.register_buffer("hangs_on", hanging_on(own), persistent=False)
        self.register_buffer("other_side", other_side(self.joints), persistent=False)
        self.register_buffer("upright", torch.tensor([1.0, 0, 0, 0, 1, 0]), persistent=False)
        self.lift = nn.Linear(6, 64)
        self.features = nn.Linear(64, width)
        self.whole = nn.Linear(width, 2 * width)
        self.from_whole = nn.Linear(2 * width, width)
        self.mix = nn.ModuleList(nn.Linear(width, width) for _ in range(2))
        self.around = nn.ModuleList(Around(width) for _ in range(_ROUNDS))
        self.part = nn.Linear(width, len(parents))
        self.rest = nn.Linear(width, 3)
        self.pooled = nn.Linear(width, _POOLED)
        self.token = nn.Linear(_POOLED + _MOMENTS, token_width)
        self.embedding = nn.Parameter(torch.randn(len(parents), token_width) * 0.02)
        self.blocks = nn.ModuleList(Attention(token_width) for _ in range(blocks))
        self.norm = nn.LayerNorm(token_width)
        self.out = nn.Linear(token_width, 9)
        with torch.no_grad():
            self.out.weight *= 0.1

    def forward(
        self,
        *,
        source: Tensor,
        target: Tensor,
        source_surface: Surface | None = None,
        target_surface: Surface | None = None,
    ) -> Tensor:
        """Return ``[b, n_target, 3]`` in a box of its own for ``[b, n_source, 3]`` and ``[b, n_target, 3]``.

        Outside of training mode every mesh is read again at rest (`read_again`), and the output is read in its turn:
        errors in reading that source and output share, being in one pose, cancel in the correction. Half of it is
        taken, as it has errors of its own.

        Parameters
        ----------
        source, target
            In the normalised box of each mesh.
        source_surface, target_surface
            What is near along their surfaces; None where that is not known: what touches is near then.

        Raises
        ------
        ValueError
            Shapes or types do not fit (:func:`training.networks.layers.input_checks.check_pair`).
        """
        check_pair(source, target, self.lift.weight.dtype)
        with full_precision(source):
            if self.training:
                surfaces = (source_surface, target_surface) if source_surface and target_surface else None
                return self.posed_like(target, self.read_pair(source, target, surfaces))
        return self.posed_target(source, self.read_target(target, target_surface), source_surface)

    def read_target(
        self, target: Tensor, surface: Surface | None = None, *, as_read: Tensor | None = None
    ) -> ReadTarget:
        """Return what is read off targets [b, n, 3] in their normalised boxes: once for any number of sources.

        Rotations and joints are read again at rest, and so are the logits of a mesh that is its own sample.

        ``as_read``: where their vertices are to be read, without noise, say; by default where they are.
        """
        read = target if as_read is None else as_read
        check_pair(target, read, self.lift.weight.dtype)
        with full_precision(target):
            drawn = sample(read, surface)
            of_all = self.read(drawn, read)
            found = self.read_again(drawn, of_all._replace(logits=taken(of_all.logits, drawn.rows)))
            is_its_sample = drawn.rows.shape == of_all.logits.shape[:2]
            logits = taken(found.logits, drawn.rows.argsort(dim=1)) if is_its_sample else of_all.logits
            return ReadTarget(
                target, read, drawn, _weights(logits, drawn, self.hangs_on, self._steps), found.rotations, found.joints
            )

    def posed_target(
        self,
        source: Tensor,
        target: ReadTarget,
        surface: Surface | None = None,
        *,
        heard: Callable[[Tensor], Tensor] | None = None,
        twice: Tensor | None = None,
        alike: Tensor | None = None,
    ) -> Tensor:
        """Return what calling the network outside of training does, of targets that were read before.

        ``heard`` gives of outputs [b, n, 3] what is to be read of them, in boxes of their own; by default as they are.
        ``twice`` says which sources and outputs [b] are read as their mirror images, too: what is read wrongly of a
        rough mesh is partly chance, and the mean of both has less of it. Without effect where no parts are called
        left and right. ``alike`` says which sources [b] list the target's vertices in the target's order.
        They are read at the vertices at which the target and the output are, so that more of the errors cancel; of
        surfaces the target's counts. It is asked on the CPU.
        """
        check_pair(source, target.vertices, self.lift.weight.dtype)
        with full_precision(source):
            if alike is None or not bool(alike.any()):
                return self._corrected(self._rotations(sample(source, surface), twice), target, heard, twice)
            drawn = target.drawn
            broken = source.sum((1, 2)) * 0  # not a number where one is, in the sample or not
            wanted = self._rotations(drawn.moved(taken(source, drawn.rows)), twice) + broken[:, None, None, None]
            if not bool(alike.all()):
                of_others = self._rotations(sample(source, surface), twice)
                wanted = torch.where(alike.to(source.device)[:, None, None, None], wanted, of_others)
            return self._corrected(wanted, target, heard, twice)

    def read(self, drawn: Sample, vertices: Tensor | None = None) -> Reading:
        """Return what is read off a sample's vertices, or off all [b, n, 3] of the meshes that it was drawn from."""
        known = _OfSample()
        features = self._passed(drawn.around, drawn, known)
        logits, rest = self.part(features), self.rest(features)
        turns, joints = self._pose(drawn, features, logits, rest)
        if vertices is not None:
            features = self._of_all(vertices, drawn, features, known)
            logits, rest = self.part(features), self.rest(features)
        return Reading(logits, rest, turns, joints)

    def read_again(self, drawn: Sample, first: Reading) -> Reading:
        """Return the mean of what was read of a sample, and of what is read where that poses it to rest.

        Parts lie apart at rest, and what is read wrongly there is mostly something else. A joint lies on two parts:
        what was missed of it is turned as the one and as the other, by halves. ``rest`` stays.
        """
        found, missed = self._at_rest(drawn, first)
        rotations = first.rotations
        both = (rotations + rotations[:, self.parents]) / 2
        return first._replace(
            logits=(first.logits + found.logits) / 2,
            rotations=rotations @ halved(found.rotations),
            joints=first.joints + (both @ missed[..., None])[..., 0] / 2,
        )

    def _at_rest(self, drawn: Sample, reading: Reading) -> tuple[Reading, Tensor]:
        """What is read of a sample that a reading posed to rest, and how far off [b, part, 3] its joints are there."""
        if drawn.surface is not None:
            sampled = drawn.surface.at(drawn.rows)
            near = _near_parts(reading.logits, sampled, drawn.masses, self.hangs_on, self._steps)
            reading = reading._replace(logits=_of_near(reading.logits, near, sampled))
        rest = self.posed_to_rest(drawn.vertices, reading)
        found = self.read(drawn.moved(rest.vertices))
        return found, rest.half * found.joints + rest.middle - rest.joints

    def posed_to_rest(self, vertices: Tensor, reading: Reading) -> AtRest:
        """Return meshes [b, n, 3] as what was read of each of their vertices poses them to rest."""
        joints, back = reading.joints, reading.rotations.mT
        at_rest = moved_joints(joints, back, self.parents, self.above)
        posed = skinned(vertices, reading.logits.softmax(2), back, joints, at_rest)
        middle, half = box(posed)
        return AtRest((posed - middle) / half, at_rest, middle, half)

    @torch.inference_mode()
    def understood(self, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """Return how badly meshes [b, n, 3] are understood, and how they are turned.

        Returns
        -------
        tuple
            The misfit [b]: what is left where each part is its rest, turned; a mean of squares over the surface, in the
            mesh' box. A mesh that stands as in training leaves little, one that lies on its side or is no body of the
            kind that was learned leaves much. And the rotation [b, 3, 3] of the root from rest.
        """
        with full_precision(vertices):
            drawn = sample(vertices)
            reading = self.read(drawn)
            moments = _moments(reading, drawn)
            fits = (reading.rotations * moments.crossed).sum((2, 3))
            fit, rest, all_of_it = (
                (moments.mass * each).sum(1) for each in (fits, moments.squares_at_rest, moments.squares)
            )
            misfit = all_of_it - fit.clamp_min(0).square() / rest.clamp_min(1e-12)
            return misfit / moments.mass.sum(1).clamp_min(1e-12), reading.rotations[:, 0]

    @torch.no_grad()
    def rest_error(self, reading: Reading, drawn: Sample) -> Tensor:
        """Return by how much the network misreads meshes of which it read the sample alone, in degrees [b].

        By the reading each mesh is posed to rest and read again: all parts should stand as at rest. The root of the
        mean over the parts of the squared angle by which they do not. Of a body that is read rightly that is a few
        degrees, whatever it wears; what is no body makes another mesh at rest than the network took it for.
        """
        with full_precision(drawn.vertices):
            found = self._at_rest(drawn, reading)[0].rotations
            cosine = (found.diagonal(dim1=2, dim2=3).sum(2) - 1) / 2
            return torch.rad2deg(cosine.clamp(-1, 1).acos()).square().mean(1).sqrt()

    def skinning_weights(self, drawn: Sample, vertices: Tensor) -> Tensor:
        """Return weights [b, n, part] of vertices [b, n, 3] of meshes with such a sample, as they are first read."""
        known = _OfSample()
        features = self._passed(drawn.around, drawn, known)
        return _weights(self.part(self._of_all(vertices, drawn, features, known)), drawn, self.hangs_on, self._steps)

    def read_pair(
        self, source: Tensor, target: Tensor, surfaces: tuple[Surface, Surface] | None = None
    ) -> tuple[Reading, Reading]:
        """Return the readings of all vertices of both [b, n, 3], together where they are equally many."""
        if source.shape != target.shape:
            of_source, of_target = surfaces or (None, None)
            return self.read(sample(source, of_source), source), self.read(sample(target, of_target), target)
        both = torch.cat([source, target])
        halves = [each.chunk(2) for each in self.read(sample(both, surfaces and joined(surfaces)), both)]
        return Reading._make(first for first, _ in halves), Reading._make(second for _, second in halves)

    def posed_like(self, target: Tensor, readings: tuple[Reading, Reading]) -> Tensor:
        """Return the target's vertices in the source's pose, by rotations as they were read; gradients reach both."""
        wanted, own = readings
        return self.posed(target, own.logits.softmax(2), own.joints, wanted.rotations @ own.rotations.mT)

    def posed(self, vertices: Tensor, weights: Tensor, joints: Tensor, turns: Tensor) -> Tensor:
        """Return vertices [b, n, 3] in a box of their own, the parts being turned [b, part, 3, 3] about the joints."""
        moved = moved_joints(joints, turns, self.parents, self.above)
        return boxed(skinned(vertices, weights, turns, joints, moved))

    def _rotations(self, drawn: Sample, twice: Tensor | None) -> Tensor:
        """Rotations of the parts [b, part, 3, 3]; of some meshes [b] the mean of what they and their images say."""

        def read(some: Sample) -> Tensor:
            return self.read_again(some, self.read(some)).rotations

        found = read(drawn)
        if twice is None or self.other_side is None:
            return found
        of_image = mirrored(read(drawn.mirrored())[:, self.other_side])
        both = nearest_rotations((found + of_image).flatten(0, 1)).view_as(found)
        return torch.where(twice[:, None, None, None], both, found)

    def _corrected(
        self,
        wanted: Tensor,
        target: ReadTarget,
        heard: Callable[[Tensor], Tensor] | None,
        twice: Tensor | None,
    ) -> Tensor:
        """Targets' vertices [b, n, 3] by the rotations that are wanted, turned by half of what their outputs miss."""
        vertices, as_read, drawn, weights, own, joints = target
        turns = wanted @ own.mT
        output = self.posed(as_read, weights, joints, turns)
        heard_of = output if heard is None else heard(output)
        found = self._rotations(drawn.moved(taken(heard_of, drawn.rows)), twice)
        return self.posed(vertices, weights, joints, halved(wanted @ found.mT) @ turns)

    def _of_all(self, vertices: Tensor, drawn: Sample, features: Tensor, known: _OfSample) -> Tensor:
        """Features [b, n, width] of all vertices, those of the sample [b, k, width] being known."""
        rows, found = [drawn.rows], [features]
        for some, around in others(vertices, drawn):
            rows.append(some)
            found.append(self._passed(around, drawn, known.again()))
        return taken(torch.cat(found, dim=1), torch.cat(rows, dim=1).argsort(dim=1))

    def _passed(self, around: Surroundings, drawn: Sample, known: _OfSample) -> Tensor:
        """Features [b, n, width] of vertices; norms, maximum and what is around are of the sample."""

        def normed(layer: nn.Module, features: Tensor, shift: Tensor | None = None) -> Tensor:
            assert isinstance(layer, nn.Linear)
            return known.normed(layer, features, drawn.masses, shift)

        def mixed(features: Tensor, layer: nn.Module) -> Tensor:
            assert isinstance(layer, Around)
            heard = around.mean(known(layer.tells, features, drawn.masses))
            return features + layer.change(normed(layer.mixed, torch.cat([features, heard], dim=2)))

        first, second = self.mix
        features = normed(self.lift, torch.cat([around.vertices, around.offsets], dim=2))
        features = mixed(normed(self.features, features), self.around[0])
        whole = known(self._whole, features, drawn.masses)
        features = mixed(normed(first, features, whole), self.around[1])
        features = mixed(normed(second, features), self.around[2])
        return mixed(features, self.around[3])

    def _whole(self, features: Tensor, masses: Tensor) -> Tensor:
        whole = torch.relu(self.whole(features)).masked_fill(masses[..., None] == 0, 0).amax(dim=1)
        return self.from_whole(whole)[:, None]

    def _pose(self, drawn: Sample, features: Tensor, logits: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations [b, part, 3, 3] and joints [b, part, 3], from what the vertices of each part have in common."""
        pooled, at, away = self.pooled(features), drawn.vertices, drawn.around.offsets
        shares = (logits.softmax(2) * drawn.masses[..., None]).mT
        mass = shares.sum(2, keepdim=True)
        both = torch.cat([pooled, away, at, rest, _products(at, at), _products(at, rest)], dim=2)
        mean = shares @ both / (mass + 1e-4)
        pooled, middle, at_rest, squares, crossed = torch.split(mean, [_POOLED + 3, 3, 3, 9, 9], dim=2)
        moments = [squares - _products(middle, middle), crossed - _products(middle, at_rest), 10 * mass]
        tokens = self.token(torch.cat([pooled, middle, at_rest, *moments], dim=2)) + self.embedding
        for block in self.blocks:
            tokens = block(tokens)
        found = self.out(self.norm(tokens))
        return rotations_from_six(found[..., :6] + self.upright), middle + found[..., 6:]


class Around(nn.Module):
    """What the vertices around each one say, along the surface where that is known; it changes nothing at first."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.told = nn.Linear(width, _TOLD, bias=False)
        self.mixed = nn.Linear(width + _TOLD, width, bias=False)
        self.change = nn.Linear(width, width)
        with torch.no_grad():
            self.change.weight.zero_()
            self.change.bias.zero_()

    def tells(self, features: Tensor, masses: Tensor) -> Tensor:
        """What the sample's vertices say [b, k, c], times their masses [b, k]."""
        told: Tensor = masses[..., None] * self.told(features)
        return told


class _OfSample:
    """What is computed of the sample: once, and told again in the same order to the vertices that are not in it."""

    def __init__(self) -> None:
        self._known: list[Any] = []
        self._told: Iterator[Any] | None = None

    def __call__(self, compute: Callable[..., Tensor], *inputs: Tensor) -> Tensor:
        if self._told is None:
            self._known.append(compute(*inputs))
        known: Tensor = self._known[-1] if self._told is None else next(self._told)
        return known

    def normed(self, layer: nn.Linear, features: Tensor, masses: Tensor, shift: Tensor | None) -> Tensor:
        """A layer's outputs [b, n, c], normed as those of the sample are, shifted, and what is below zero cut off."""
        if self._told is not None:  # one product: norm and shift are taken into its weights
            bias, weight = next(self._told)
            return torch.baddbmm(bias, features, weight).relu_()
        outputs: Tensor = layer(features)
        mean, scale = _statistics(outputs, masses)

        def shifted(values: Tensor) -> Tensor:
            return values if shift is None else values + shift

        at_zero = 0 if layer.bias is None else layer.bias
        self._known.append(lambda: (shifted((at_zero - mean) * scale), layer.weight.mT * scale))
        return shifted((outputs - mean) * scale).relu_()

    def again(self) -> _OfSample:
        if self._told is None:
            self._known = [known() if callable(known) else known for known in self._known]
        self._told = iter(self._known)
        return self


def _statistics(outputs: Tensor, masses: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and inverse deviation [b, 1, c] of what comes out for the sample [b, k, c]."""
    mean = masses[:, None] @ outputs
    variance = (masses[:, None] @ outputs.square() - mean.square()).clamp_min(0)
    return mean, torch.rsqrt(variance + _VARIANCE_FLOOR)


def _weights(logits: Tensor, drawn: Sample, hangs_on: Tensor, steps: int = _STEPS) -> Tensor:
    """Skinning weights [b, n, part] of all vertices of a sample's meshes, none of a part that is not near, or hangs on
    nothing there.
    """
    if drawn.surface is None:
        return logits.softmax(2)
    near = _near_parts(taken(logits, drawn.rows), drawn.surface.at(drawn.rows), drawn.masses, hangs_on, steps)
    return _of_near(logits, near, drawn.surface).softmax(2)


def _near_parts(logits: Tensor, surface: Surface, masses: Tensor, hangs_on: Tensor, steps: int) -> Tensor:
    """Which parts the vertices of each cell [b, cell, part] may follow, by a sample's logits [b, k, part].

    A few vertices of a back that are taken for an upper arm's would fly away with it, and so would a left hand that
    lies in the right one and is taken for it, wrist and all, but at an elbow that is the left one's. So a part is
    followed where it hangs on the root: the root itself does, and near where a part does, along the surface, more of it
    does, and what hangs on it in the skeleton (`hanging_on`), from place to place in so many steps. How much of a part
    is near is told by the masses of the sample [b, k], however finely the mesh is meshed there. Where nothing that is
    near hangs so, all that is near may be followed, and where nothing is near, all. Where a mesh is of several pieces,
    each of which is near to all of the others, whatever there is hangs on the root.
    """
    shares = logits.softmax(2) * masses[..., None]
    beside = surface.near.to(shares.dtype)
    cells = surface.cells[..., None].expand_as(shares)
    in_cell = shares.new_zeros(*beside.shape[:2], shares.shape[2]).scatter_add(1, cells, shares)
    share = beside @ in_cell / in_cell.sum(1, keepdim=True).clamp_min(1e-12)
    is_there = ((share >= _LEAST_HOLDING * share.amax(1, keepdim=True)) & (share > 0)).to(share.dtype)
    hanging = is_there * (hangs_on.sum(0) == 1)  # the roots
    for _ in range(steps):
        hanging = is_there * (beside @ hanging @ hangs_on > 0)
    near = share >= _LEAST_NEAR
    held = near & (beside @ hanging @ hangs_on > 0)
    near = torch.where(held.any(2, keepdim=True), held, near)
    return near | ~near.any(2, keepdim=True)


def _of_near(logits: Tensor, near: Tensor, surface: Surface) -> Tensor:
    """Logits [b, n, part] of a surface's vertices, of parts that are near their cells [b, cell, part]."""
    return logits.masked_fill(~near.gather(1, surface.cells[..., None].expand_as(logits)), -torch.inf)


class _Moments(NamedTuple):
    """Of the vertices of each part, sharply told apart, as they are and as they rest: masses [b, part], means
    [b, part, 3], sums of squares about them [b, part] and products of both [b, part, 3, 3].
    """

    mass: Tensor
    squares: Tensor
    squares_at_rest: Tensor
    crossed: Tensor


def _moments(reading: Reading, drawn: Sample) -> _Moments:
    shares = (reading.logits.softmax(2).square() * drawn.masses[..., None]).mT
    mass = shares.sum(2, keepdim=True)
    shares = shares / mass.clamp_min(1e-12)
    at, rest = drawn.vertices, reading.rest
    middle, at_rest = shares @ at, shares @ rest
    squares, squares_at_rest = (
        (shares @ both.square()).sum(2) - mean.square().sum(2) for both, mean in ((at, middle), (rest, at_rest))
    )
    crossed = matrices(shares @ _products(at, rest) - _products(middle, at_rest))
    return _Moments(mass[..., 0], squares, squares_at_rest, crossed)


_HEADS = 4
_ROUNDS, _TOLD = 4, 64
_POOLED = 32
_MOMENTS = 3 + 3 + 3 + 9 + 9 + 1


class Attention(nn.Module):
    """Attention between the parts' tokens, and a layer for each (Vaswani et al. 2017, norms first)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        self.asked = nn.Linear(width, 3 * width)
        self.answer = nn.Linear(width, width)
        self.own = nn.Sequential(nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width))

    def forward(self, tokens: Tensor) -> Tensor:
        """Return ``[b, part, width]`` for as much."""
        first, second = self.norms
        query, key, value = self.asked(first(tokens)).unflatten(2, (3, _HEADS, -1)).permute(2, 0, 3, 1, 4)
        heard = nn.functional.scaled_dot_product_attention(query, key, value)
        tokens = tokens + self.answer(heard.transpose(1, 2).flatten(2))
        return tokens + self.own(second(tokens))


def boxed(vertices: Tensor) -> Tensor:
    """Return vertices [b, n, 3] in their own box: its middle at the origin, half its longest edge one."""
    middle, half = box(vertices)
    return (vertices - middle) / half


def _products(first: Tensor, second: Tensor) -> Tensor:
    """Products [b, n, 9] of each coordinate of one [b, n, 3] with each of the other."""
    return (first[..., :, None] * second[..., None, :]).flatten(2)
