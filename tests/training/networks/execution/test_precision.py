"""What a network does in other precisions: half refused on purpose, autocast only where it is borne."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import cosine_similarity
from torch.utils._python_dispatch import TorchDispatchMode

from tests.support.three_networks import BY_AREA, FORMS, LITERAL, fitted, initial, lively, loss_gradients, pair
from training.networks.corenet3d import CoreNet3D
from training.networks.layers.pose_encoder import PoseEncoder

HALF = [torch.float16, torch.bfloat16]
BOUND = {"dsffnet": 0.05, "npt maxpool": 0.06, "npt origin": 0.11, "corenet3d": 0.19}
"""Of the relative error of an initial network's gradients in bfloat16; measured 0.025, 0.030, 0.052 and 0.092."""
BOUND_FITTED = 0.02
"""The same after forty steps of training; measured 0.004 to 0.006."""


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("dtype", HALF, ids=str)
@pytest.mark.parametrize("name", ["source", "target", "network", "all"])
def test_half_precision_is_refused_with_the_way_to_have_it(form: str, dtype: torch.dtype, name: str) -> None:
    network, inputs = initial(form), pair(form)
    for mesh in inputs:
        if name in (mesh, "all"):
            inputs[mesh] = inputs[mesh].to(dtype)
    if name in ("network", "all"):
        network.to(dtype)
    what = {"network": "parameters", "target": "target vertices"}.get(name, "source vertices")
    short = str(dtype).removeprefix("torch.")
    message = rf"{what} must be float32 or float64, got {short}; .* use training\.precision=bfloat16 \(autocast\)"
    with pytest.raises(ValueError, match=message):
        network(**inputs)


class _Read(nn.Module):
    """After a spectral norm: keep the weights that it gives, and whether autocast was on."""

    def __init__(self) -> None:
        super().__init__()
        self.weights: list[Tensor] = []
        self.under_autocast: list[bool] = []

    def forward(self, weight: Tensor) -> Tensor:
        self.weights.append(weight.detach().clone())
        self.under_autocast.append(torch.is_autocast_enabled("cpu"))
        return weight


def _weights_read(*, autocast: bool) -> tuple[list[Tensor], list[bool]]:
    """Return the nine weights under spectral norms of one forward pass in training mode, and autocast at each."""
    network = lively("corenet3d").train()
    assert isinstance(network, CoreNet3D)
    reads = []
    for block in (network.generator.block1, network.generator.block2, network.generator.block3):
        for layer in (block.linear0, block.linear1, block.shortcut):
            reads.append(_Read())
            layer.parametrizations.weight.append(reads[-1])
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        network(**pair("corenet3d"))
    assert all(len(read.weights) == 1 for read in reads)
    return [read.weights[0] for read in reads], [read.under_autocast[0] for read in reads]


def test_spectral_norms_are_computed_in_float32_whatever_autocast_does() -> None:
    plain, _ = _weights_read(autocast=False)
    found, under_autocast = _weights_read(autocast=True)
    assert len(found) == 9 and not any(under_autocast)
    for one, other in zip(found, plain, strict=True):
        assert one.dtype == torch.float32 and torch.equal(one, other)


class _Products(TorchDispatchMode):
    """Record the dtypes of batched matrix products."""

    def __init__(self) -> None:
        super().__init__()
        self.dtypes: set[torch.dtype] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func is torch.ops.aten.bmm.default:
            self.dtypes.add(args[0].dtype)
        return func(*args, **(kwargs or {}))


@torch.no_grad()
@pytest.mark.parametrize("dtype", HALF, ids=str)
def test_the_encoder_searches_in_the_active_dtype_and_returns_exact_values(dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    encoder, source = PoseEncoder((16, 32, 64)), pair("dsffnet", source=500)["source"]
    features = encoder.features(source)
    with torch.autocast("cpu", dtype), _Products() as seen:
        found = encoder(source)
    assert seen.dtypes & set(HALF) == {dtype}
    assert found.dtype == torch.float32
    # The value at some vertex, to float32's rounding, and at one that is the largest but for rounding to 8 bits.
    assert (features - found.unsqueeze(1)).abs().amin(dim=1).max() < 1e-5
    assert (features.amax(dim=1) - found).max() < 2**-7 * features.max()


@torch.no_grad()
@pytest.mark.parametrize("form", LITERAL)
def test_float16_autocast_errs_less_than_bfloat16(form: str) -> None:
    network, inputs = lively(form, wide=True).eval(), pair(form, source=200, target=150)
    full, error = network(**inputs), {}
    for dtype in HALF:
        with torch.autocast("cpu", dtype):
            found = network(**inputs)
        assert found.dtype == torch.float32
        error[dtype] = ((found - full).square().mean().sqrt() / full.std()).item()
    assert 0 < error[torch.float16] < 0.5 * error[torch.bfloat16] < 0.02


def _rounded(network: nn.Module, inputs: dict[str, Tensor]) -> tuple[float, float]:
    """Return the relative error of all gradients under bfloat16, and the least cosine of a wide layer's weight."""
    full = loss_gradients(network, inputs)
    with torch.autocast("cpu", torch.bfloat16):
        half = loss_gradients(network, inputs)
    expected, found = (torch.cat([value.flatten() for value in each.values()]) for each in (full, half))
    share = 1e-4 * expected.norm()  # what is smaller is noise in float32 as well
    wide = [name for name, value in full.items() if value.numel() >= 1000 and value.norm() > share]
    assert wide
    cosine = min(cosine_similarity(full[name].flatten(), half[name].flatten(), dim=0).item() for name in wide)
    return ((found - expected).norm() / expected.norm()).item(), cosine


@pytest.mark.parametrize("form", LITERAL)
@pytest.mark.parametrize("trained", [False, True], ids=["initial", "fitted"])
def test_gradients_under_autocast_are_those_of_float32_and_nearer_than_the_plain_equations_come(
    form: str, trained: bool
) -> None:
    network = (fitted(form) if trained else initial(form, wide=True)).eval()
    inputs = pair(form, source=400, target=300)
    error, cosine = _rounded(network, inputs)
    assert 0 < error < (BOUND_FITTED if trained else BOUND[form])
    assert cosine > 0.97
    assert error < _rounded(LITERAL[form](network), inputs)[0]


@pytest.mark.parametrize("form", [*FORMS, *BY_AREA])
def test_every_parameter_gets_a_finite_float32_gradient_under_autocast(form: str) -> None:
    network = lively(form)
    with torch.autocast("cpu", torch.bfloat16):
        gradients = loss_gradients(network, pair(form))
    assert all(value.dtype == torch.float32 and torch.isfinite(value).all() for value in gradients.values())


def test_a_bias_before_elain_keeps_its_gradient_under_autocast() -> None:
    """It moves nothing but a mean. Added to features before they are rounded, its gradient erred by 86 % (now 12 %)."""
    network, inputs = initial("corenet3d", wide=True).eval(), pair("corenet3d", source=400, target=300)
    full = _random_functional(network, inputs)
    with torch.autocast("cpu", torch.bfloat16):
        half = _random_functional(network, inputs)
    for name in ("generator.block1.linear0.bias", "generator.linear2.bias", "generator.block1.linear1.bias"):
        error = (half[name] - full[name]).norm() / full[name].norm()
        assert error < 0.3, name


def _random_functional(network: nn.Module, inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    network.zero_grad()
    output = network(**inputs)
    (output * torch.randn(output.shape, generator=torch.Generator().manual_seed(5))).mean().backward()
    return {name: parameter.grad for name, parameter in network.named_parameters()}
