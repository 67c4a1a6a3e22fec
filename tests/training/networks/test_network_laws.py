"""What every network keeps, whichever paper it is of; `tests/literal` holds the papers' equations."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from pydantic import TypeAdapter
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from tests.support.ranks.one_rank import two_backward_passes
from tests.support.three_networks import (
    BY_AREA,
    FORMS,
    LITERAL,
    PAIRING,
    functional_gradients,
    initial,
    lively,
    pair,
    plain,
)
from training.networks import NETWORKS, network_from
from training.networks.layers import modulation, optimal_transport, pose_encoder
from training.networks.layers.sampling import MOST_SAMPLED
from training.recipes.networks import NETWORK_NAMES, CoreNet3dRecipe, DsffnetRecipe, NetworkRecipe, NptRecipe

ABLATIONS: dict[str, dict[str, Any]] = {
    "dsffnet without fusion": {"feature_fusion": False},
    "dsffnet without target side": {"target_side": False},
}
ALL = [*FORMS, *ABLATIONS, *BY_AREA]
WITH_EQUATIONS = [name for name in ALL if name != "parts"]
"""Those that tests/literal holds, equation by equation."""
DOUBLE = torch.float64
RECIPES = {"dsffnet": DsffnetRecipe, "npt": NptRecipe, "corenet3d": CoreNet3dRecipe}


def form_of(name: str) -> str:
    return "dsffnet" if name in ABLATIONS else name


def literal_of(name: str, network: nn.Module) -> nn.Module:
    return LITERAL[plain(form_of(name))](network)


def network_of(name: str, dtype: torch.dtype = DOUBLE, **options: Any) -> nn.Module:
    """A network in training mode, in which every pass of 3D-CoreNet's iterates its spectral norms."""
    return lively(form_of(name), dtype=dtype, **ABLATIONS.get(name, {}), **options)


def pair_of(name: str, dtype: torch.dtype = DOUBLE, **counts: int) -> dict[str, Tensor]:
    return pair(form_of(name), dtype=dtype, **counts)


@pytest.mark.parametrize(
    ("name", "count"),
    [("dsffnet", 9_371_023), ("npt maxpool", 6_054_941), ("npt origin", 6_054_941), ("corenet3d", 24_461_447)],
)
def test_parameter_counts_are_the_papers(name: str, count: int) -> None:
    assert sum(parameter.numel() for parameter in FORMS[name]().parameters()) == count


EQUATIONS: list[tuple[str, dict[str, Any], bool]] = [
    *(
        (n, {"decoder_widths": w}, True)
        for n in ("dsffnet", *ABLATIONS)
        for w in ((10, 24, 14), (24, 10, 24), (12,) * 3)
    ),
    *(
        (f"npt {v}", {"encoder_widths": w}, True)
        for v in ("maxpool", "origin")
        for w in ((8, 12, 20), (5, 6, 9), (3, 2, 1))
    ),
    *(
        ("corenet3d", options, training)
        for options in ({}, {"generator_widths": (10, 24, 12)}, {"centre_features": True})
        for training in (True, False)
    ),
    *((name, {}, True) for name in BY_AREA),
]


@pytest.mark.parametrize(("name", "options", "training"), EQUATIONS, ids=str)
def test_output_and_every_gradient_equal_the_equations(name: str, options: dict[str, Any], training: bool) -> None:
    network = network_of(name, **options).train(training)
    literal = literal_of(name, network)
    expected, found = (functional_gradients(each, pair_of(name)) for each in (literal, network))
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, rtol=1e-8, atol=1e-8, msg=lambda text, key=key: f"{key}: {text}")
    torch.testing.assert_close(found["output"], expected["output"], rtol=0, atol=1e-9)
    if options != {"encoder_widths": (3, 2, 1)}:
        assert found["source"].abs().max() > 1e-6  # else this would say nothing about the source's side


@pytest.mark.parametrize("name", LITERAL)
def test_vertices_of_equal_masses_count_as_they_do_without(name: str) -> None:
    """Those far apart at nodes of the masses' grid, each alone."""
    places = torch.cartesian_prod(*[torch.linspace(-1, 1, 3, dtype=DOUBLE)] * 3)
    inputs = {key: torch.stack([places[torch.randperm(27)[:20]] for _ in range(2)]) for key in ("source", "target")}
    uniform, area = (functional_gradients(network_of(form), inputs) for form in (name, f"{name} by area"))
    for key, value in uniform.items():
        torch.testing.assert_close(area[key], value, rtol=1e-9, atol=1e-9)


@torch.no_grad()
@pytest.mark.parametrize("name", LITERAL)
def test_by_area_vertices_given_twice_hardly_change_what_the_others_become(name: str) -> None:
    """The upper half of two bodies. What is left stems from where the halves meet; 3D-CoreNet's last neighbours too."""
    once = {key: _ellipsoid(seed) for key, seed in (("source", 1), ("target", 2))}
    twice = {key: torch.cat([mesh, mesh[:, 200:]], dim=1) for key, mesh in once.items()}
    change = {}
    for form in (name, f"{name} by area"):
        network = network_of(form).eval()
        before = network(**once)
        moved = (network(**twice)[:, :400] - before).square().mean().sqrt()
        change[form] = (moved / before.std(dim=1).mean()).item()
    assert change[f"{name} by area"] < (0.1 if name == "corenet3d" else 0.02)
    assert change[name] > 0.3 > 5 * change[f"{name} by area"]


def _ellipsoid(seed: int) -> Tensor:
    points = torch.randn(2, 400, 3, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)
    points = points / points.norm(dim=2, keepdim=True) * torch.tensor([0.5, 1, 0.3], dtype=DOUBLE)
    return torch.stack([mesh[mesh[:, 1].argsort()] for mesh in points])


@torch.no_grad()
@pytest.mark.parametrize("start", [initial, lively])
@pytest.mark.parametrize("name", WITH_EQUATIONS)
def test_float32_is_as_exact_as_the_equations_in_float32(name: str, start: Any) -> None:
    """Rounding, in a box of 2. A few vertices of 3D-CoreNet magnify it (even the exact generator, that of the warped
    points by 7), others on another CPU; its root mean square is the same on all."""
    network = start(form_of(name), wide=True, **ABLATIONS.get(name, {})).eval()
    inputs = pair_of(name, torch.float32, source=300, target=200)
    found, literal = network(**inputs), literal_of(name, network)(**inputs)
    exact = network.double()(**{key: mesh.double() for key, mesh in inputs.items()})
    error, usual = (found - exact).abs(), (literal - exact).abs()
    if plain(name) == "corenet3d":
        assert error.square().mean().sqrt() < min(4e-6, 2 * usual.square().mean().sqrt())
        assert error.max() < 2 * usual.max() + 1e-5
    else:
        assert error.max() < min(2e-5, 2 * usual.max())


@pytest.mark.parametrize("name", ALL)
def test_chunks_do_not_change_the_result(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    network = network_of(name).eval()
    whole = functional_gradients(network, pair_of(name))
    monkeypatch.setattr(modulation, "CHUNK_ELEMENTS", 100)
    monkeypatch.setattr(pose_encoder, "ARGMAX_ELEMENTS", 200)
    monkeypatch.setattr(optimal_transport, "BLOCK_ELEMENTS", 100)
    monkeypatch.setattr(optimal_transport, "KEPT_ELEMENTS", 0)
    for key, value in functional_gradients(network, pair_of(name)).items():
        torch.testing.assert_close(value, whole[key], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("name", [name for name in ALL if plain(name) != PAIRING])
def test_the_sources_order_changes_nothing(name: str) -> None:
    network, inputs = network_of(name).eval(), pair_of(name)
    moved = network(source=inputs["source"][:, torch.randperm(33)], target=inputs["target"])
    torch.testing.assert_close(moved, network(**inputs), rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", [name for name in ALL if plain(name) != "corenet3d"])
def test_the_targets_order_is_that_of_the_output(name: str) -> None:
    """3D-CoreNet reads neighbours in the list; NPT's origin pairs source and target, which are ordered together."""
    network, inputs, order = network_of(name).eval(), pair_of(name), torch.randperm(27)
    source = inputs["source"][:, order] if plain(name) == PAIRING else inputs["source"]
    moved = network(source=source, target=inputs["target"][:, order])
    torch.testing.assert_close(moved, network(**inputs)[:, order], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", WITH_EQUATIONS)
@pytest.mark.parametrize(("source", "target"), [(2, 7), (40, 2), (5, 60)])
def test_few_vertices_give_what_the_equations_give(name: str, source: int, target: int) -> None:
    network, inputs = network_of(name).eval(), pair_of(name, source=source, target=target)
    torch.testing.assert_close(network(**inputs), literal_of(name, network)(**inputs), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize(("source", "target"), [(1, 1), (2, 2), (1, 9), (9, 1)])
def test_a_single_vertex_is_moved_somewhere_finite(name: str, source: int, target: int) -> None:
    output = network_of(name)(**pair_of(name, source=source, target=target))
    assert output.shape == (2, target, 3) and torch.isfinite(output).all()


@pytest.mark.parametrize("name", ALL)
def test_meshes_of_a_batch_do_not_mix(name: str) -> None:
    network, inputs = network_of(name).eval(), pair_of(name)
    alone = network(**{key: mesh[1:] for key, mesh in inputs.items()})
    torch.testing.assert_close(network(**inputs)[1:], alone, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ALL)
def test_the_same_pass_gives_the_same_bits(name: str) -> None:
    one, other = (functional_gradients(network_of(name), pair_of(name)) for _ in range(2))
    assert all(torch.equal(value, other[key]) for key, value in one.items())


@pytest.mark.parametrize(
    ("name", "latent"), [("dsffnet", (2, 24)), ("npt maxpool", (2, 29)), ("npt origin", (2, 27, 29))]
)
def test_a_pose_encoded_once_serves_many_targets(name: str, latent: tuple[int, ...]) -> None:
    network, inputs = network_of(name), pair_of(name)
    encoded = network.encode(inputs["source"])
    assert encoded.shape == latent
    for target in (inputs["target"], inputs["target"].flip(2)):
        expected = network(source=inputs["source"], target=target)
        assert torch.equal(network.decode(latent=encoded, target=target), expected)


_ENCODER = {f"encoder.layers.{i}" for i in range(3)}
DEAD = {
    "dsffnet": _ENCODER
    | {f"decoder.{layer}" for layer in ("lift", "linear2", "linear3")}
    | {f"decoder.block{i}.linear{j}" for i in (1, 2) for j in (1, 2)},
    "npt maxpool": _ENCODER
    | {f"decoder.linear{i}" for i in (2, 3)}
    | {f"decoder.block{i}.linear{which}" for i in (1, 2) for which in ("2", "_residual")}
    | {f"decoder.block{i}.linear1" for i in (2, 3)},
    "corenet3d": {f"features.layers.{i}" for i in range(3)}
    | {f"features.blocks.{i}.linear{j}" for i in range(4) for j in (1, 2)},
}
DEAD["parts"] = {"lift", "features", "mix.0", "mix.1", "around.1.change"}
DEAD["npt origin"] = DEAD["npt maxpool"] | {"decoder.lift", "decoder.block1.linear1"}
"""Layers whose bias the norm after them takes away."""


@pytest.mark.parametrize("name", ALL)
def test_every_parameter_receives_a_gradient_and_dead_biases_receive_zero(name: str) -> None:
    network = network_of(name)
    network(**pair_of(name)).square().sum().backward()
    assert [key for key, parameter in network.named_parameters() if parameter.grad is None] == []
    dead = {key for key, parameter in network.named_parameters() if parameter.grad.abs().max() < 1e-13}
    assert dead == {f"{layer}.bias" for layer in DEAD[plain(form_of(name))]}


@pytest.mark.parametrize("name", ALL)
def test_distributed_data_parallel_needs_no_search_for_unused_parameters(name: str) -> None:
    two_backward_passes(network_of(name), pair_of(name))


@torch.no_grad()
@pytest.mark.parametrize("start", [initial, lively])
@pytest.mark.parametrize("name", ALL)
def test_under_autocast_the_result_stays_close_and_float32(name: str, start: Any) -> None:
    """At first NPT's features vary by a hundredth of their size over a mesh: there a plain autocast errs by a fifth."""
    network = start(form_of(name), wide=True, **ABLATIONS.get(name, {})).eval()
    inputs = pair_of(name, torch.float32, source=200, target=150)
    full = network(**inputs)
    with torch.autocast("cpu", torch.bfloat16):
        half = network(**inputs)
    assert half.dtype == torch.float32
    error = (half - full).square().mean().sqrt() / full.std(dim=1).mean()
    if name == "parts":  # small, and all rotations and coordinates: it takes no notice
        assert error == 0
    else:
        assert 0 < error < (0.02 if plain(form_of(name)) == "dsffnet" else 0.03)


@torch.no_grad()
@pytest.mark.parametrize("name", [*FORMS, "dsffnet by area"])
def test_export_gives_the_same_output_for_other_vertex_numbers(name: str) -> None:
    network = network_of(name, torch.float32, **({"blocks": 1} if name == "parts" else {})).eval()
    example, other = (pair_of(name, torch.float32, **counts) for counts in ({}, {"source": 41, "target": 17}))
    least, most = (3, MOST_SAMPLED) if name == "parts" else (2, 10_000)  # beyond that parts samples as many
    source, target = (torch.export.Dim(f"{key}_vertices", min=least, max=most) for key in example)
    free = {"source": {1: target if plain(name) == PAIRING else source}, "target": {1: target}}
    exported = torch.export.export(network, (), example, dynamic_shapes=free).module()
    torch.testing.assert_close(exported(**other), network(**other), rtol=0, atol=1e-5)


@pytest.mark.gpu
@pytest.mark.parametrize("name", ALL)
def test_a_gpu_gives_the_same_gradients_every_time_and_those_of_the_cpu(name: str) -> None:
    network, inputs = network_of(name).eval(), pair_of(name, source=300, target=200)
    expected = {key: value.clone() for key, value in functional_gradients(network, inputs).items()}
    network.cuda()  # and with it its gradients
    one, other = (functional_gradients(network, {key: mesh.cuda() for key, mesh in inputs.items()}) for _ in range(2))
    for key, value in expected.items():
        assert torch.equal(one[key], other[key]), key
        torch.testing.assert_close(one[key].cpu(), value, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("name", FORMS)
def test_safetensors_round_trip(name: str, tmp_path: Path) -> None:
    network, other, inputs = network_of(name).eval(), network_of(name, seed=9).eval(), pair_of(name)
    assert not torch.equal(network(**inputs), other(**inputs))
    save_file(network.state_dict(), tmp_path / "weights.safetensors")
    other.load_state_dict(load_file(tmp_path / "weights.safetensors"))
    assert torch.equal(network(**inputs), other(**inputs))


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        ((2, 3, 30), (2, 25, 3), r"source must be .*\[batch, vertex, 3\].*\[2, 3, 30\]"),
        ((2, 30, 3), (25, 3), r"target must be .*\[25, 3\]"),
        ((2, 0, 3), (2, 25, 3), r"source must be .*\[2, 0, 3\]"),
        ((2, 0, 3), (2, 0, 3), r"source must be .*\[2, 0, 3\]"),
        (
            (2, 30, 3),
            (3, 25, 3),
            r"latent must be \[3, 2[49]\], got \[2, 2[49]\]|equally many, got shapes \[2, 30, 3\] and \[3, 25, 3\]",
        ),
    ],
)
def test_errors_carry_the_shapes(name: str, source: Any, target: Any, message: str) -> None:
    """NPT's origin pairs vertices, and says so first."""
    if name == PAIRING and source != target:
        message = re.escape(f"shapes must be equal: got {list(source)} and {list(target)}")
    with pytest.raises(ValueError, match=message):
        network_of(name, torch.float32)(source=torch.zeros(source), target=torch.zeros(target))


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.int64], ids=str)
def test_another_dtype_than_the_parameters_is_refused(name: str, dtype: torch.dtype) -> None:
    inputs = pair_of(name, torch.float32)
    with pytest.raises(ValueError, match=rf"target must be a torch\.float32 tensor .* got {dtype}"):
        network_of(name, torch.float32)(source=inputs["source"], target=inputs["target"].to(dtype))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("dsffnet", {"encoder_widths": (8, 8)}, "widths must be three positive"),
        ("dsffnet", {"decoder_widths": (8, 0, 8)}, "widths must be three positive"),
        ("dsffnet", {"feature_fusion": False, "target_side": False}, "choose one"),
        ("npt", {"encoder_widths": (8, 8)}, r"three positive integers, got \(8, 8\)"),
        ("npt", {"encoder_widths": (8, 0, 8)}, "three positive integers"),
        ("dsffnet", {"norm_weights": "mass"}, "norm_weights must be 'uniform' or 'area', got 'mass'"),
        ("npt", {"norm_weights": "Area"}, "norm_weights must be 'uniform' or 'area', got 'Area'"),
        ("corenet3d", {"norm_weights": ""}, "norm_weights must be 'uniform' or 'area', got ''"),
        ("npt", {"variant": "max"}, "'maxpool' or 'origin', got 'max'"),
        ("corenet3d", {"feature_widths": (8, 8)}, "feature_widths must be three positive"),
        ("corenet3d", {"generator_widths": (8, 0, 8)}, "generator_widths must be three positive"),
    ],
)
def test_what_cannot_be_built_is_refused(name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NETWORKS[name](**options)


@pytest.mark.parametrize("name", ["dsffnet", "npt", "corenet3d"])
def test_a_recipe_says_how_much_vertices_count(name: str) -> None:
    widths = {key: (8, 8, 8) for key in RECIPES[name].model_fields if key.endswith("_widths")}
    for norm_weights in ("uniform", "area"):
        section = {"name": name, "norm_weights": norm_weights} | widths
        assert network_from(RECIPES[name].model_validate(section)).norm_weights == norm_weights
    assert NETWORKS[name](**widths).norm_weights == RECIPES[name]().norm_weights == "uniform"


def test_every_network_of_a_recipe_is_built_by_its_name() -> None:
    assert set(NETWORK_NAMES) == set(NETWORKS) == {name.split()[0] for name in FORMS}
    for name, constructor in NETWORKS.items():
        assert isinstance(network_from(TypeAdapter(NetworkRecipe).validate_python({"name": name})), constructor)
