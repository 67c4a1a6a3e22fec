"""Training recipes: what cannot be meant is refused in one line that says what to set."""

from typing import Any

import pytest
from pydantic import ValidationError

from training.recipes.training import PATH_KEYS, TrainingRecipe, block_bytes, budget_seconds

ORIGIN = {"name": "npt", "variant": "origin"}


@pytest.mark.parametrize(
    "values, message",
    [
        (
            {"network": ORIGIN, "augmentation": {"vertices": 0.5}},
            "'origin' pairs source and target by index, but augmentation.vertices 0.5 .*set augmentation.vertices to 1",
        ),
        (
            {"network": ORIGIN, "augmentation": {"shuffle": True}},
            "'origin' pairs source and target by index, but augmentation.shuffle is true: set augmentation.shuffle to",
        ),
        (
            {"network": ORIGIN, "augmentation": {"source_holes": 0.2}},
            "augmentation.source_holes 0.2 leaves vertices out: set augmentation.source_holes to 0, or",
        ),
        (
            {"augmentation": {"proportions": 0.2}},
            "needs the rigs that network 'parts' is told of, but the network is 'dsffnet': set augmentation",
        ),
        ({"network": {"name": "parts", "norm_weights": "area"}}, "Extra inputs are not permitted"),
        ({"network": {"norm_weights": "mass"}}, "Input should be 'uniform' or 'area'"),
        (
            {"early_stopping": 3, "steps": 400},
            "with evaluate_every 500 there is none before the last of 400 steps: set evaluate_every lower",
        ),
        ({"schedule": {"name": "linear", "warm_up": 0.3, "hold": 0.2}}, "warm_up 0.3 is more than hold 0.2: set hold"),
        ({"batch": 8, "ranks": 2, "accumulate": 3}, "batch 8 cannot be shared equally by 2 ranks in 3 parts each"),
        ({"ranks": 2, "launcher": "inline"}, "launcher 'inline' is one process, but ranks is 2; use launcher 'ray'"),
        ({"fewest_ranks": 2}, "fewest_ranks 2 is more than ranks 1"),
        ({"block": "16"}, "'16' is not a size such as 500MB or 16GB"),
        ({"network": {"name": "template"}, "block": "1GB"}, "network 'template' knows no block"),
        ({"budget": "10 parsecs"}, "'10 parsecs' is not a time such as 90s, 10min or 2.5h"),
    ],
)
def test_what_cannot_be_meant_says_what_to_set(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message) as raised:
        TrainingRecipe.model_validate(values)
    (fault,) = raised.value.errors()
    assert "\n" not in fault["msg"]


@pytest.mark.parametrize(
    "values",
    [
        {"network": ORIGIN, "augmentation": {"source_noise": 0.1}},
        {"network": {"name": "npt"}, "augmentation": {"source_holes": 0.5}},
        {"network": {"name": "npt"}, "augmentation": {"vertices": 0.5}},
        {"early_stopping": 3, "steps": 501},
        {"early_stopping": 3},
        {"schedule": {"name": "linear", "warm_up": 0.2, "hold": 0.2}},
        {"schedule": {"name": "cosine", "warm_up": 0.9}},
    ],
)
def test_what_can_be_meant_is_let_through(values: dict[str, Any]) -> None:
    TrainingRecipe.model_validate(values)


def test_budgets_are_times() -> None:
    assert [budget_seconds(text) for text in ("90s", "10min", "2.5h", " 1 h ")] == [90, 600, 9000, 3600]


def test_blocks_are_sizes() -> None:
    assert [block_bytes(text) for text in ("80kB", "1.5 MB", "16GB", " 2TB ")] == [80e3, 15e5, 16e9, 2e12]


def test_paths_are_fields() -> None:
    assert set(TrainingRecipe.model_fields) >= PATH_KEYS
