"""NPT: how its weights begin, what its variant `origin` pairs, and recipes of it."""

from __future__ import annotations

import pytest
import torch

from tests.support.three_networks import lively, meshes
from training.networks import network_from
from training.networks.npt import NPT
from training.recipes.networks import DsffnetRecipe, NptRecipe
from training.recipes.training import TrainingRecipe

NARROW = (8, 12, 20)
DOUBLE = torch.float64


def test_weights_begin_as_released() -> None:
    torch.manual_seed(0)
    network = NPT(encoder_widths=(64, 128, 256))
    layer = network.decoder.block1.linear1
    assert layer.weight.std().item() == pytest.approx(0.02, rel=0.02) and abs(layer.weight.mean().item()) < 1e-3
    bound = layer.in_features**-0.5
    assert 0.9 * bound < layer.bias.abs().max() <= bound
    assert network.encoder.layers[0].weight.std().item() == pytest.approx(0.02, rel=0.2)


def test_origin_depends_on_how_vertices_are_paired() -> None:
    source, target = (meshes(25, seed=seed, dtype=DOUBLE) for seed in (1, 2))
    network, order = lively("npt origin", dtype=DOUBLE), torch.randperm(25)
    output = network(source=source, target=target)
    assert (network(source=source[:, order], target=target) - output).abs().max() > 1e-2


def test_origin_refuses_the_poses_of_a_mesh_with_other_vertices() -> None:
    network = lively("npt origin", encoder_widths=NARROW)
    with pytest.raises(ValueError, match=r"latent must be \[2, 25, 20\], got \[2, 30, 20\]"):
        network.decode(latent=network.encode(meshes(30, seed=1)), target=meshes(25, seed=2))


def test_a_recipe_builds_it_and_recipes_without_a_name_mean_dsffnet() -> None:
    recipe = TrainingRecipe.model_validate({"network": {"name": "npt", "variant": "origin", "encoder_widths": NARROW}})
    network = network_from(recipe.network)
    assert isinstance(network, NPT) and network.variant == "origin" and network.decoder.lift.in_features == 23
    assert TrainingRecipe.model_validate({"network": {"target_side": False}}).network == DsffnetRecipe(
        target_side=False
    )
    assert TrainingRecipe().network == DsffnetRecipe()
    assert TrainingRecipe.model_validate(TrainingRecipe(network=NptRecipe()).model_dump()).network == NptRecipe()
