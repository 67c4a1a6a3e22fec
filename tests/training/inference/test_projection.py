"""Outputs projected onto rigid parts: what is rigid comes back to the digit, what is not gets its target's shape."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from datagen.common.errors import RecipeError
from datagen.generate import inline
from datagen.store import open_dataset
from tests.support.recipes import PARTS, tiny_training
from tests.support.three_networks import lively, meshes
from training.data.batch import read_batch
from training.engine.trainer import train
from training.evaluation.evaluate import Method, evaluate
from training.inference.predict import load_trained, predict
from training.inference.projection import OntoParts, projected
from training.networks.layers.sampling import sample
from training.objectives.metrics import point_mesh_distance
from training.recipes.training import EvaluationRecipe


def two_parts() -> tuple[torch.Tensor, torch.Tensor]:
    """A target [2, 80, 3] and its weights: two halves, and a third part that has no vertices."""
    weights = torch.zeros(2, 80, 3)
    weights[:, :40, 0] = weights[:, 40:, 1] = 1
    return meshes(80, seed=1), weights


def test_parts_that_were_turned_moved_and_scaled_together_are_found_to_the_digit() -> None:
    target, weights = two_parts()
    turn = torch.from_numpy(Rotation.random(2, random_state=0).as_matrix()).float()
    output = target * 1.3
    output[:, :40] = output[:, :40] @ turn.mT + torch.tensor([0.2, 0.0, -0.1])
    found = projected(output, target, weights, sample(target))
    torch.testing.assert_close(found, output, rtol=0, atol=1e-5)


def test_noise_of_an_output_is_taken_away_and_a_reflection_is_never_fitted() -> None:
    target, weights = two_parts()
    noise = 0.05 * torch.randn(target.shape, generator=torch.Generator().manual_seed(2))
    clean = projected(target, target, weights, sample(target))
    found = projected(target + noise, target, weights, sample(target))
    assert (found - clean).square().mean() < 0.3 * noise.square().mean()
    mirrored = projected(target * torch.tensor([-1.0, 1, 1]), target, weights, sample(target))
    of_part = mirrored[0, :40] - mirrored[0, :40].mean(0), target[0, :40] - target[0, :40].mean(0)
    assert torch.linalg.det(of_part[0].T @ of_part[1]) > 0


@pytest.fixture(scope="module")
def parts(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the parts network, of two steps."""
    folder = tmp_path_factory.mktemp("parts")
    train(tiny_training(**PARTS, steps=2, edge_weight=0), data=str(_pristine), run=folder)
    return folder


def test_a_row_of_its_own(dataset: str, parts: Path, tmp_path: Path) -> None:
    train(tiny_training(steps=2), data=dataset, run=tmp_path / "run")
    methods = [Method(name, str(tmp_path / "run"), by) for name, by in (("DSFFNet", ""), ("projected", str(parts)))]
    rows = evaluate(methods, dataset, EvaluationRecipe(emd_points=16), tasks=inline)
    opened = open_dataset(dataset)
    batch = read_batch(opened, opened.evaluation_triples("unseen"), surfaces=True)
    network = load_trained(tmp_path / "run")[0]
    for method, its in zip(methods, (network, OntoParts.of(network, parts)), strict=True):
        found = [row.pmd for row in rows if (row.method, row.pose_type) == (method.name, "unseen")]
        np.testing.assert_allclose(found, point_mesh_distance(predict(its, batch), batch.truth), rtol=1e-4)


def test_an_output_that_is_no_number_stays_so_in_its_pair() -> None:
    target, weights = two_parts()
    output = target.clone()
    output[0, 3] = torch.nan
    found = projected(output, target, weights, sample(target))
    assert found[0].isnan().all() and found[1].isfinite().all()


def test_what_does_not_go_together_is_refused(dataset: str, parts: Path, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="lies on rigid parts already"):
        OntoParts.of(load_trained(parts)[0], parts)
    train(tiny_training(steps=1), data=dataset, run=tmp_path / "run")
    with pytest.raises(RecipeError, match="are those of DSFFNet: name human or animals"):
        OntoParts.of(lively("dsffnet"), tmp_path / "run")
