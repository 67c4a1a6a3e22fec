"""Comparisons: what comes with the project resolves, methods share data and budget, and what cannot be is refused."""

from pathlib import Path

import pytest

from datagen.common.errors import RecipeError
from workflows.studies.comparison.plan import ComparisonKind, known_comparisons, plan_comparison

KINDS: tuple[ComparisonKind, ...] = ("comparison", "ablation")
EVERY = [(kind, name) for kind in KINDS for name in known_comparisons(kind)]


def test_there_are_small_and_paper_sized_ones_for_humans_and_animals() -> None:
    for kind in KINDS:
        assert set(known_comparisons(kind)) == {"small", "animals-small", "paper", "animals-paper"}


@pytest.mark.parametrize(("kind", "name"), EVERY)
def test_all_methods_learn_from_as_many_triples_of_one_dataset(kind: ComparisonKind, name: str) -> None:
    comparison = plan_comparison(name, kind=kind)
    recipes = [trial.recipe for trial in comparison.methods.values()]
    assert all(recipe.data == recipes[0].data for recipe in recipes)
    grid = recipes[0].data
    epoch = grid.identities.training * grid.poses.seen
    triples = {t.steps * t.batch if t.steps else t.epochs * epoch for t in (recipe.training for recipe in recipes)}
    assert len(triples) == 1, triples
    assert len({recipe.training.evaluate_triples for recipe in recipes}) == 1


def test_the_three_methods_are_three_networks_and_the_ablations_what_the_paper_leaves_out() -> None:
    three = plan_comparison("small", kind="comparison").methods
    assert [trial.training.network.name for trial in three.values()] == ["dsffnet", "npt", "corenet3d"]
    assert list(three) == ["DSFFNet", "NPT", "3D-CoreNet"]
    four = {name: trial.training for name, trial in plan_comparison("small", kind="ablation").methods.items()}
    whole, fusion, side, edge = four.values()
    assert list(four) == ["DSFFNet", "w/o FFAdaIN", "w/o side target", "w/o L_edge"]
    assert (whole.network.feature_fusion, whole.network.target_side, whole.edge_weight) == (True, True, 0.0005)
    assert not fusion.network.feature_fusion and not side.network.target_side and edge.edge_weight == 0
    assert [trial.name for trial in plan_comparison("small", kind="ablation").methods.values()][1] == "w-o-FFAdaIN"


def test_words_of_the_command_are_for_all_methods() -> None:
    comparison = plan_comparison("small", ["training.steps=7", "data.poses.seen=9"], kind="comparison")
    assert {trial.training.steps for trial in comparison.methods.values()} == {7}
    assert comparison.sweep.recipe.data.poses.seen == 9


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("methods: []", "methods: .*at least 1 item"),
        ("methods: [{name: a, sets: []}]", r"methods.0.sets: Extra inputs"),
        ("methods: [{name: a, set: [training.stepz=3]}]", "unknown key 'training.stepz', did you mean"),
        ("methods: [{name: a, set: [data.poses.seen=3]}]", "only keys of training can differ"),
        ("methods: [{name: a}, {name: a}]", "2 trials are called 'a'"),
        ("methods: [", "cannot be read"),
    ],
)
def test_what_is_no_comparison_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(RecipeError, match=message) as raised:
        plan_comparison(str(file), kind="comparison")
    assert "\n" not in str(raised.value)


def test_an_unknown_name_brings_the_nearest_and_all_others() -> None:
    with pytest.raises(RecipeError, match=r"no ablation 'smal', did you mean 'small'.*animals-paper"):
        plan_comparison("smal", kind="ablation")
