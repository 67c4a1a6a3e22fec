"""Recipes: names, files, overrides, and errors that a person can act on."""

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from datagen.errors import RecipeError
from workflows.recipe import WorkflowRecipe, describe_fields, known_recipes, load_recipe, save_recipe


@pytest.mark.parametrize("name", sorted(known_recipes()))
def test_every_shipped_recipe_loads_and_describes_itself(name: str) -> None:
    assert load_recipe(name).description


def test_the_quickstart_is_what_the_readme_says() -> None:
    recipe = load_recipe("quickstart")
    assert recipe.data.identities.training == 16 and recipe.data.poses.seen >= 200
    assert recipe.data.identities.evaluation >= 8 and recipe.data.poses.unseen > 0
    assert recipe.training.ranks == 2 and recipe.training.launcher == "ray"


def test_defaults_are_the_papers() -> None:
    recipe = WorkflowRecipe()
    training = recipe.training
    assert (training.learning_rate, training.batch, training.epochs, training.edge_weight) == (1e-3, 8, 200, 5e-4)
    assert (training.schedule.name, training.schedule.decay, training.schedule.decay_epochs) == ("step", 0.8, 8)
    assert training.network.encoder_widths == (64, 128, 1024) and training.network.decoder_widths == (256, 1024, 256)
    assert (recipe.data.identities.training, recipe.data.poses.seen, recipe.data.poses.unseen) == (16, 400, 400)


@given(st.permutations(["data.identities.seed=7", "training.steps=12", "data.body.topology=notoes_collapse3pc"]))
def test_overrides_apply_in_any_order(overrides: list[str]) -> None:
    recipe = load_recipe("quickstart", overrides)
    assert recipe.data.identities.seed == 7 and recipe.training.steps == 12
    assert recipe.data.body.topology == "notoes_collapse3pc"  # type: ignore[union-attr]


def test_saved_and_read_again_it_is_the_same(tmp_path: Path) -> None:
    recipe = load_recipe("smoke", ["training.seed=3"])
    save_recipe(recipe, tmp_path / "recipe.yaml")
    assert load_recipe(str(tmp_path / "recipe.yaml")) == recipe


@pytest.mark.parametrize(
    "overrides, message",
    [
        (["training.learning_rat=1"], r"unknown key 'training.learning_rat', did you mean 'training.learning_rate'\?"),
        (["data.body.topolgy=anny"], r"unknown key 'data.body.topolgy', did you mean 'data.body.topology'\?"),
        (["trainig.steps=5"], r"unknown key 'trainig', did you mean 'training"),
        (["training.batch=many"], r"training.batch: .*integer.*\(given: 'many'\)"),
        (["training.batch=0"], r"training.batch: .*greater than or equal to 1 \(given: 0\)"),
        (["training.batch=9"], r"batch 9 cannot be shared equally by 2 ranks"),
        (["data.body.family=smurf"], r"data.body: .*'anny', 'smpl'"),
        (["data.body.phenotypes.age=[0.9,0.1]"], r"data.body.phenotypes: .*age: need 0 <= low <= high <= 1"),
        (["training.steps"], r"--set 'training.steps' is not of the form section.key=value"),
    ],
)
def test_mistakes_are_named(overrides: list[str], message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        load_recipe("quickstart", overrides)


def test_a_network_is_chosen_by_name_and_the_keys_of_another_do_not_stay() -> None:
    chosen = load_recipe("quickstart", ["training.network.name=npt", "training.network.variant=origin"])
    assert chosen.training.network.model_dump() == {
        "name": "npt", "variant": "origin", "encoder_widths": (64, 128, 1024),
    }  # fmt: skip
    plain = load_recipe("quickstart")
    assert load_recipe("quickstart", ["training.network.name=dsffnet"]) == plain  # what no name means: nothing changes
    with pytest.raises(RecipeError, match=r"training.network: .*'nptt'.*'dsffnet', 'npt'"):
        load_recipe("quickstart", ["training.network.name=nptt"])
    with pytest.raises(
        RecipeError, match=r"'training.network.decoder_widths' is a key of another kind of 'training.net"
    ):
        load_recipe("quickstart", ["training.network.name=npt", "training.network.decoder_widths=[8,8,8]"])


def test_unknown_names_and_files(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="no recipe 'quikstart', did you mean 'quickstart'"):
        load_recipe("quikstart")
    with pytest.raises(RecipeError, match=r"no recipe file .*mine\.yaml"):
        load_recipe(str(tmp_path / "mine.yaml"))
    (tmp_path / "bad.yaml").write_text("a: [1")
    with pytest.raises(RecipeError, match="cannot be read"):
        load_recipe(str(tmp_path / "bad.yaml"))
    (tmp_path / "list.yaml").write_text("[1, 2]")
    with pytest.raises(RecipeError):
        load_recipe(str(tmp_path / "list.yaml"))


def test_help_lists_every_key() -> None:
    keys = {line.split()[0] for line in describe_fields()}

    def leaves(values: dict, prefix: str = "") -> set[str]:
        found: set[str] = set()
        for key, value in values.items():
            found |= leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key}
        return found

    assert leaves(yaml.safe_load(yaml.safe_dump(WorkflowRecipe().model_dump(mode="json")))) <= keys


def test_relative_paths_are_those_beside_the_recipe_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "m.npz").write_bytes(b"")
    (tmp_path / "r.yaml").write_text("data: {body: {family: smpl, path: m.npz}}")
    recipe = load_recipe(str(tmp_path / "r.yaml"))
    assert recipe.data.body.path == str(tmp_path / "m.npz")  # type: ignore[union-attr]
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:6379")
    with pytest.raises(RecipeError, match=r"'m.npz' is a relative path.*name a full one"):
        load_recipe(str(tmp_path / "r.yaml"))


def test_a_folder_called_animals_is_not_mistaken_for_the_animals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "animals").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_recipe("animals-paper").data.body.path == "animals"  # type: ignore[union-attr]


def test_a_key_may_count_the_entries_of_a_list(tmp_path: Path) -> None:
    (tmp_path / "r.yaml").write_text("data: {body: {family: mixed, bodies: [{family: leg}, {family: leg, rings: 9}]}}")
    recipe = load_recipe(str(tmp_path / "r.yaml"), ["data.body.bodies.1.rings=12"])
    assert [body.rings for body in recipe.data.body.bodies] == [24, 12]  # type: ignore[union-attr]


def test_a_dataset_of_nobody_is_refused() -> None:
    with pytest.raises(RecipeError, match="training and evaluation are both 0"):
        load_recipe("smoke", ["data.identities.training=0", "data.identities.evaluation=0"])
