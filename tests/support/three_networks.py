"""The networks in all their forms, small, with their literal oracles: for tests that hold for every one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import is_parametrized

from tests.literal.corenet3d import LiteralCoreNet3D
from tests.literal.dsffnet import LiteralDSFFNet
from tests.literal.npt import LiteralNPT
from training.networks.corenet3d import CoreNet3D
from training.networks.dsffnet import DSFFNet
from training.networks.npt import NPT
from training.networks.parts import Parts
from training.networks.released_weights import DSFFNET_PARTS, NPT_PARTS, released_name, released_names

FORMS: dict[str, Callable[..., nn.Module]] = {
    "dsffnet": DSFFNet,
    "npt maxpool": NPT,
    "npt origin": lambda **options: NPT(variant="origin", **options),
    "corenet3d": CoreNet3D,
    "parts": lambda **options: Parts(**{"joints": FOUR_JOINTS} | options),
}
FOUR_JOINTS = {"pelvis": None, "spine": "pelvis", "head": "spine", "left_leg": "pelvis"}
LITERAL: dict[str, Callable[[Any], nn.Module]] = {
    "dsffnet": LiteralDSFFNet,
    "npt maxpool": LiteralNPT,
    "npt origin": LiteralNPT,
    "corenet3d": LiteralCoreNet3D,
}
BY_AREA = [f"{form} by area" for form in LITERAL]
"""The same whose vertices count in norms by the area around them; names for `initial`, `lively` and `pair`."""
PAIRING = "npt origin"
"""The form whose source and target must have equally many vertices."""

_NARROW: dict[str, dict[str, Any]] = {
    "dsffnet": {"encoder_widths": (8, 16, 24), "decoder_widths": (16, 32, 16)},
    "npt": {"encoder_widths": (8, 16, 29)},
    "corenet3d": {"feature_widths": (8, 8, 16), "generator_widths": (32, 16, 16)},
    "parts": {"width": 16, "token_width": 8, "blocks": 2},
}
_WIDE: dict[str, dict[str, Any]] = {
    "dsffnet": {"encoder_widths": (32, 64, 256), "decoder_widths": (64, 256, 64)},
    "npt": {"encoder_widths": (32, 64, 253)},
    "corenet3d": {"feature_widths": (32, 64, 64), "generator_widths": (256, 128, 64)},
    "parts": {"width": 64, "token_width": 32, "blocks": 2},
}


def initial(form: str, *, wide: bool = False, seed: int = 0, **options: Any) -> nn.Module:
    """Return the form as it is before training, in float32; ``options`` of its constructor go before its widths."""
    torch.manual_seed(seed)
    if form in BY_AREA:
        options = {"norm_weights": "area"} | options
    return FORMS[plain(form)](**(_WIDE if wide else _NARROW)[form.split(maxsplit=1)[0]] | options)


def plain(form: str) -> str:
    """Return the name of a form without its weights."""
    return form.removesuffix(" by area")


def lively(
    form: str, *, wide: bool = False, seed: int = 0, dtype: torch.dtype = torch.float32, **options: Any
) -> nn.Module:
    """Return the form with weights that keep the size of what they act on, so that every part of it has an effect."""
    network = initial(form, wide=wide, seed=seed, **options).to(dtype)
    for name, parameter in network.named_parameters():
        if parameter.ndim == 2:
            nn.init.normal_(parameter, 0, parameter.shape[1] ** -0.5)
        else:
            nn.init.uniform_(parameter, -0.5, 0.5)
        if name.endswith("out.weight"):
            with torch.no_grad():
                parameter.mul_(0.2)
    for layer in network.modules():
        if is_parametrized(layer, "weight"):  # a spectral norm, whose singular vectors must fit the new weight
            left, _, right = torch.linalg.svd(layer.parametrizations.weight.original.detach())
            layer.parametrizations.weight[0]._u.copy_(left[:, 0])
            layer.parametrizations.weight[0]._v.copy_(right[0])
    return network


def meshes(vertices: int, *, seed: int, batch: int = 2, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return vertices in a box of 2."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch, vertices, 3, generator=generator, dtype=dtype) * 2 - 1


def pair(form: str, *, source: int = 33, target: int = 27, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """Return a source and a target, of different numbers of vertices where the form takes them."""
    source = target if plain(form) == PAIRING else source
    return {"source": meshes(source, seed=1, dtype=dtype), "target": meshes(target, seed=2, dtype=dtype)}


def loss_gradients(network: nn.Module, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the gradients of a mean squared error by the names of the parameters."""
    network.zero_grad()
    _loss(network, inputs).backward()
    return {name: parameter.grad.clone() for name, parameter in network.named_parameters()}


def functional_gradients(network: nn.Module, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the output and all gradients of a random functional of it, parameters by the fast form's names."""
    network.zero_grad()
    inputs = {name: mesh.detach().clone().requires_grad_() for name, mesh in inputs.items()}
    output = network(**inputs)
    weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(5), dtype=output.dtype)
    (output * weights.to(output.device)).sum().backward()
    gradients = {own_name(network, name): parameter.grad.flatten() for name, parameter in network.named_parameters()}
    return {"output": output.detach()} | {name: mesh.grad for name, mesh in inputs.items()} | gradients


def own_name(network: nn.Module, name: str) -> str:
    """Return the name of a parameter in the fast form; the literal 3D-CoreNet has the released ones."""
    if not isinstance(network, LiteralCoreNet3D):
        return name
    parts = ("correspondence", "generator")
    return {f"{part}.{given}": own for part in parts for own, given in released_names(part).items()}[name]


def fitted(form: str, steps: int = 40) -> nn.Module:
    """Return the wide form after some steps of training towards a smooth function of both meshes."""
    network = initial(form, wide=True)
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    for step in range(steps):
        optimiser.zero_grad()
        _loss(network, {"source": meshes(300, seed=10 + step), "target": meshes(300, seed=1000 + step)}).backward()
        optimiser.step()
    return network


def _loss(network: nn.Module, inputs: dict[str, Tensor]) -> Tensor:
    source, target = inputs["source"], inputs["target"]
    pose = source.square().mean(dim=1, keepdim=True)
    truth = 0.6 * target + 0.3 * torch.sin(15 * pose + target.flip(2))
    return (network(**inputs) - truth).square().mean()


def to_released(network: DSFFNet | NPT) -> dict[str, Tensor]:
    """The state_dict that the authors' module loads: of convolutions of kernel 1, by their names."""
    parts = DSFFNET_PARTS if isinstance(network, DSFFNet) else NPT_PARTS
    own = network.state_dict().items()
    return {released_name(name, parts): value[..., None] if value.ndim == 2 else value for name, value in own}
