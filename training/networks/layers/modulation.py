"""Instance normalisation modulated by position: the functions of the papers, at a fraction of their cost.

Shapes: ``b`` meshes, ``n`` vertices, ``c`` channels; arrays are channels-last. Homogeneous coordinates are
``(x, y, z, 1)``, so that one affine map from a vertex to ``c`` channels is one ``[4, c]`` matrix.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

SAMPLED = 16
"""One vertex in this many decides such a constant: any near the mean will do."""


def centred_for_autocast(features: Tensor) -> Tensor:
    """Return ``[b, n, c]`` features as autocast's products take them; without autocast the features themselves.

    Under bfloat16 a constant is taken from each channel of each mesh: about its mean. What follows must not depend on
    such constants, as an instance norm after a linear layer does not.
    """
    device = features.device.type
    if not torch.is_autocast_enabled(device) or features.dtype != torch.float32:
        return features
    constant = features.detach()[:, ::SAMPLED].mean(dim=1, keepdim=True)
    if torch.compiler.is_compiling():
        return (features - constant).to(torch.get_autocast_dtype(device))
    return cast(Tensor, _Centred.apply(features, constant, torch.get_autocast_dtype(device)))  # type: ignore[no-untyped-call]


class _Centred(torch.autograd.Function):
    """Difference and rounding in one pass over memory."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, constant: Tensor, dtype: torch.dtype) -> Tensor:
        return torch.sub(features, constant, out=torch.empty_like(features, dtype=dtype))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return gradient.float(), None, None


VARIANCE_FLOOR = 1e-5
"""Added to the variance in every instance norm (the default of ``torch.nn.InstanceNorm1d``, as released)."""

CHUNK_ELEMENTS = 2**17
"""On a CPU, elements of an array worked on at a time: half a mebibyte of float32, so that temporaries stay in cache."""


def vertex_mean(features: Tensor, masses: Tensor | None) -> Tensor:
    """Return the mean ``[b, 1, c]`` of ``[b, n, c]`` over the vertices, each of its mass ``[b, n, 1]``; None: equal."""
    return features.mean(dim=1, keepdim=True) if masses is None else masses.mT @ features


def total_mass(features: Tensor, masses: Tensor | None) -> int:
    """Return what the weights of the vertices of ``[b, n, c]`` add up to: one, or `n` where each counts as one."""
    return features.shape[1] if masses is None else 1


def homogeneous(coordinates: Tensor) -> Tensor:
    """Append a one to every vertex: ``[b, n, 3]`` to ``[b, n, 4]``."""
    return nn.functional.pad(coordinates, (0, 1), value=1.0)


@contextlib.contextmanager
def full_precision(array: Tensor) -> Iterator[None]:
    """Without the ambient autocast and TF32: norms, coordinates and poses do not bear them."""
    with torch.autocast(array.device.type, enabled=False):
        if torch.compiler.is_compiling() or torch.get_float32_matmul_precision() == "highest":
            yield
            return
        before = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("highest")
        try:
            yield
        finally:
            torch.set_float32_matmul_precision(before)


class FFAdaIN(nn.Module):
    """Feature fusion adaptive instance normalisation (DSFFNet, section 3.3), as two ``[4, c]`` affine maps a mesh.

    ``FFAdaIN(h, v, z) = IN(h) * sigma + mu`` with ``sigma = alpha sigma_mix(z, v) + (1 - alpha) sigma_id(v)`` and
    ``mu = beta mu_mix(z, v) + (1 - beta) mu_id(v)``. The latent pose ``z`` is the same for all vertices of a mesh, so
    both are affine in the vertex ``v``, with coefficients that depend only on the mesh.

    Parameters
    ----------
    channels
        Channels ``c`` of the modulated features.
    latent
        Length of the pose vector ``z``.
    fusion
        False leaves the identity branch only: SPAdaIN.
    target_side
        False leaves the mixed branch only.
    """

    def __init__(self, *, channels: int, latent: int, fusion: bool = True, target_side: bool = True) -> None:
        super().__init__()
        self.fusion, self.target_side = fusion, target_side
        if target_side:
            self.identity_scale = nn.Linear(3, channels)
            self.identity_shift = nn.Linear(3, channels)
        if fusion:
            self.mixed_scale = nn.Linear(latent + 3, channels)
            self.mixed_shift = nn.Linear(latent + 3, channels)
        if fusion and target_side:
            self.alpha = nn.Parameter(torch.zeros(1))
            self.beta = nn.Parameter(torch.zeros(1))

    def forward(self, probe: Tensor) -> tuple[Tensor, Tensor]:
        """Return the maps of scale and shift, ``[b, 4, c]`` each, for the meshes' `probe` (see `pose_probe`)."""
        if not self.fusion:
            size = (probe.shape[0], -1, -1)
            return affine_map(self.identity_scale).expand(size), affine_map(self.identity_shift).expand(size)
        with full_precision(probe):
            scale, shift = posed_map(self.mixed_scale, probe), posed_map(self.mixed_shift, probe)
        if not self.target_side:
            return scale, shift
        scale = torch.lerp(affine_map(self.identity_scale), scale, self.alpha)
        return scale, torch.lerp(affine_map(self.identity_shift), shift, self.beta)


def pose_probe(latent: Tensor) -> Tensor:
    """Return the ``[b, 4, latent + 3]`` inputs whose images are the affine map of a linear layer of ``[z, v]``.

    The first three rows are the unit vectors of ``v``; the last is ``[z, 0]``, the image of which is the constant.
    """
    unit = torch.eye(4, 3, dtype=latent.dtype, device=latent.device).expand(latent.shape[0], -1, -1)
    return torch.cat([nn.functional.pad(latent.unsqueeze(1), (0, 0, 3, 0)), unit], dim=2)


def affine_map(layer: nn.Linear) -> Tensor:
    """Return a linear layer of a vertex as the ``[4, c]`` map of its homogeneous coordinates."""
    return torch.cat([layer.weight.t(), layer.bias.unsqueeze(0)])


def posed_map(layer: nn.Linear, probe: Tensor) -> Tensor:
    """Return a linear layer of ``[z, v]`` as ``[b, 4, c]`` maps of homogeneous coordinates (see `pose_probe`)."""
    return nn.functional.linear(probe, layer.weight) + nn.functional.pad(layer.bias.unsqueeze(0), (0, 0, 3, 0))


def modulated_relu(
    hidden: Tensor,
    vertices: Tensor,
    scale: Tensor,
    shift: Tensor,
    *,
    normalised: bool = True,
    room: Tensor | None = None,
    masses: Tensor | None = None,
) -> Tensor:
    """Return ``relu(IN(hidden) * sigma + mu)``.

    Parameters
    ----------
    hidden
        ``[b, n, c]`` features, in any precision. Adding a constant to a channel changes nothing.
    vertices
        ``[b, n, 4]`` homogeneous coordinates.
    scale, shift
        ``[b, 4, c]``: ``sigma = vertices @ scale`` and ``mu = vertices @ shift``.
    normalised
        False leaves the instance norm out: ``relu(hidden * sigma + mu)``.
    room
        An array that is not needed any more, `hidden` itself perhaps: where no gradient is wanted, the result may take
        its place, as fresh memory costs as much time as the arithmetic.
    masses
        ``[b, n, 1]``, how much each vertex counts in the norm, in sum one, taken for constants; None: equally.

    Returns
    -------
    Tensor
        ``[b, n, c]``, in the dtype of `vertices`.
    """
    hidden = hidden.to(vertices.dtype)
    with full_precision(hidden):
        if not torch.compiler.is_compiling():
            room = _usable(room, hidden)
            given = hidden, vertices, scale, shift, normalised, room, masses
            return cast(Tensor, _ModulatedRelu.apply(*given))  # type: ignore[no-untyped-call]
        # A compiler fuses the plain expression, and could not unroll an unknown number of chunks.
        if normalised:
            hidden = hidden - vertex_mean(hidden, masses)
            scale = scale * torch.rsqrt(vertex_mean(hidden.square(), masses) + VARIANCE_FLOOR)
        return torch.relu(hidden * (vertices @ scale) + vertices @ shift)


def rounded_modulated_relu(
    hidden: Tensor,
    vertices: Tensor,
    scale: Tensor,
    shift: Tensor,
    *,
    room: Tensor | None = None,
    masses: Tensor | None = None,
) -> Tensor:
    """Return `modulated_relu` as `rounding.centred_for_autocast` then takes it, in fewer passes over memory.

    In inference under autocast on a CPU, features pass from one wide product to the next in the precision of the
    products: arrays of twice the size in between would take longer than the products themselves.
    """
    plain = torch.is_grad_enabled() or torch.compiler.is_compiling()
    if plain or hidden.dtype == vertices.dtype or hidden.device.type != "cpu":
        return centred_for_autocast(modulated_relu(hidden, vertices, scale, shift, room=room, masses=masses))
    with full_precision(hidden):
        return _rounded_modulated_relu(hidden, vertices, scale, shift, _usable(room, hidden), masses)


def _usable(room: Tensor | None, hidden: Tensor) -> Tensor | None:
    """`room` if a result of the kind of `hidden` may and can be written there."""
    fits = room is not None and room.shape == hidden.shape and room.dtype == hidden.dtype and room.is_contiguous()
    return room if fits and not torch.is_grad_enabled() else None


def _rounded_modulated_relu(
    hidden: Tensor, vertices: Tensor, scale: Tensor, shift: Tensor, room: Tensor | None, masses: Tensor | None
) -> Tensor:
    mean, deviation = _statistics(hidden, vertices.dtype, masses)
    scaled = scale * deviation
    sample = (hidden[:, ::SAMPLED] - mean).mul_(vertices[:, ::SAMPLED] @ scaled).add_(vertices[:, ::SAMPLED] @ shift)
    constant = sample.clamp_min_(0).mean(dim=1, keepdim=True)
    output = torch.empty_like(hidden) if room is None else room
    centred, sigma = _scratch(hidden, vertices), _scratch(hidden, vertices)
    for chunk in _chunks(hidden):
        rows = vertices[:, chunk]
        size = rows.shape[1]
        product = torch.bmm(rows, scaled, out=sigma[:, :size])
        product.mul_(centred[:, :size].copy_(hidden[:, chunk]).sub_(mean)).baddbmm_(rows, shift)
        output[:, chunk] = product.clamp_min_(0).sub_(constant)
    return output


class _ModulatedRelu(torch.autograd.Function):
    """Few passes over memory: chunks stay in cache, and sums over vertices are products with four rows."""

    @staticmethod
    def forward(
        ctx: Any,
        hidden: Tensor,
        vertices: Tensor,
        scale: Tensor,
        shift: Tensor,
        normalised: bool,
        room: Tensor | None,
        masses: Tensor | None,
    ) -> Tensor:
        ctx.normalised = normalised
        mean, deviation = _statistics(hidden, hidden.dtype, masses) if normalised else _no_statistics(hidden)
        scaled = scale * deviation
        output = torch.empty_like(hidden) if room is None else room
        centred, sigma = _scratch(hidden), _scratch(hidden)
        for chunk in _chunks(hidden):
            rows, part = vertices[:, chunk], output[:, chunk]
            product = torch.bmm(rows, scaled, out=sigma[:, : rows.shape[1]])
            product.mul_(torch.sub(hidden[:, chunk], mean, out=centred[:, : rows.shape[1]]))
            torch.clamp_min(product.baddbmm_(rows, shift), 0, out=part)
        ctx.save_for_backward(hidden, output, vertices, scale, shift, mean, deviation, masses)
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_output: Tensor) -> tuple[Tensor | None, ...]:
        hidden, output, vertices, scale, shift, mean, deviation, masses = ctx.saved_tensors
        gradient, grad_shift, grad_scaled = _masked_sums(grad_output, hidden, output, vertices, mean)
        grad_scale = grad_scaled * deviation
        grad_vertices = None
        if ctx.needs_input_grad[1]:
            weighted = gradient * ((hidden - mean) * deviation)
            grad_vertices = gradient @ shift.transpose(1, 2) + weighted @ scale.transpose(1, 2)
        # The derivative of an instance norm removes mean(d) and mean(d * IN(h)), d = gradient * sigma. Both are sums of
        # four products: sigma is vertices @ scale, and the sums against the four coordinates are known.
        share = 4 / total_mass(hidden, masses) if ctx.normalised else 0.0
        along_one = (scale * grad_shift).mean(dim=1, keepdim=True) * share * deviation
        along_hidden = (scale * grad_scale).mean(dim=1, keepdim=True) * share * deviation.square()
        _normalisation_gradient(
            gradient, hidden, vertices, scale * deviation, mean * along_hidden - along_one, -along_hidden, masses
        )
        return gradient, grad_vertices, grad_scale, grad_shift, None, None, None


def _statistics(hidden: Tensor, dtype: torch.dtype, masses: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return mean and ``1 / sqrt(Var + eps)`` over the vertices, ``[b, 1, c]`` in `dtype`, in one pass.

    Squares are summed about the mean of a few vertices, and by how much that is not the mean of all is found on the
    way. The chunks' sums are added in float64: in float32 the rounding of a sum over 30,000 vertices would be most of
    the network's error.
    """
    count = hidden.shape[1]
    about = hidden[:, ::SAMPLED].to(dtype).mean(dim=1, keepdim=True)
    weights = about.new_ones(1, 1, 1).expand(hidden.shape[0], 1, count) if masses is None else masses.mT
    total, scratch = total_mass(hidden, masses), _scratch(hidden, about)
    rest, squares = torch.zeros_like(about, dtype=torch.float64), torch.zeros_like(about, dtype=torch.float64)
    for chunk in _chunks(hidden):
        part = scratch[:, : len(range(count)[chunk])]
        centred = (
            part.copy_(hidden[:, chunk]).sub_(about)
            if hidden.dtype != dtype
            else torch.sub(hidden[:, chunk], about, out=part)
        )
        rest += torch.bmm(weights[:, :, chunk], centred)
        squares += torch.bmm(weights[:, :, chunk], centred.square_())
    rest /= total
    deviation = torch.rsqrt(squares / total - rest.square() + VARIANCE_FLOOR)
    return (about + rest).to(dtype), deviation.to(dtype)


def _no_statistics(hidden: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean and ``1 / sqrt(Var + eps)`` with which nothing is normalised."""
    zeros = hidden.new_zeros(hidden.shape[0], 1, hidden.shape[2])
    return zeros, torch.ones_like(zeros)


def _masked_sums(
    grad_output: Tensor, hidden: Tensor, output: Tensor, vertices: Tensor, mean: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradient before the ReLU and its products with the coordinates, plain and times centred features."""
    gradient, scratch = torch.empty_like(hidden), _scratch(hidden)
    sums = hidden.new_zeros(2, hidden.shape[0], 4, hidden.shape[2])
    for chunk in _chunks(hidden):
        part, columns = gradient[:, chunk], vertices[:, chunk].transpose(1, 2)
        torch.ops.aten.threshold_backward.grad_input(grad_output[:, chunk], output[:, chunk], 0, grad_input=part)
        sums[0].baddbmm_(columns, part)
        centred = torch.sub(hidden[:, chunk], mean, out=scratch[:, : part.shape[1]])
        sums[1].baddbmm_(columns, centred.mul_(part))
    return gradient, sums[0], sums[1]


def _normalisation_gradient(
    gradient: Tensor,
    hidden: Tensor,
    vertices: Tensor,
    scaled: Tensor,
    constant: Tensor,
    slope: Tensor,
    masses: Tensor | None,
) -> None:
    """Replace `gradient` by ``gradient * (vertices @ scaled) + masses * (constant + slope * hidden)``."""
    sigma, line = _scratch(hidden), _scratch(hidden)
    for chunk in _chunks(hidden):
        rows, part = vertices[:, chunk], gradient[:, chunk]
        size = rows.shape[1]
        torch.bmm(rows, scaled, out=sigma[:, :size])
        torch.addcmul(constant, hidden[:, chunk], slope, out=line[:, :size])
        if masses is not None:
            line[:, :size].mul_(masses[:, chunk])
        torch.addcmul(line[:, :size], part, sigma[:, :size], out=part)


def _chunk_length(array: Tensor) -> int:
    if array.device.type != "cpu":
        return array.shape[1]
    return max(1, min(array.shape[1], CHUNK_ELEMENTS // (array.shape[0] * array.shape[2])))


def _chunks(array: Tensor) -> Iterator[slice]:
    step = _chunk_length(array)
    return (slice(start, start + step) for start in range(0, array.shape[1], step))


def _scratch(array: Tensor, like: Tensor | None = None) -> Tensor:
    """Room for a chunk of `array`, in the dtype of `like`."""
    return (array if like is None else like).new_empty(array.shape[0], _chunk_length(array), array.shape[2])


class _ZeroGradients(torch.autograd.Function):
    """The first argument unchanged; the others receive gradients of zero."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, *unused: Tensor) -> Tensor:
        ctx.unused = [(parameter.shape, parameter.dtype) for parameter in unused]
        return value.view_as(value)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        return (gradient, *(torch.zeros(shape, dtype=kind, device=gradient.device) for shape, kind in ctx.unused))


def with_zero_gradients(value: Tensor, unused: Sequence[Tensor]) -> Tensor:
    """Return `value`, and let the parameters in `unused`, which have no effect on it, receive their gradient: zero.

    Distributed data parallel training waits for a gradient of every parameter.
    """
    if not torch.is_grad_enabled():
        return value
    if torch.compiler.is_compiling():
        return value + 0 * torch.cat([parameter.flatten() for parameter in unused]).sum()
    return cast(Tensor, _ZeroGradients.apply(value, *unused))  # type: ignore[no-untyped-call]
