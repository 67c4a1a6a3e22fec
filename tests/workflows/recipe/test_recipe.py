"""Recipes: names, files, overrides, and errors that a person can act on."""

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from datagen.common.errors import RecipeError
from training.recipes.training import PATH_KEYS, TrainingRecipe
from workflows.recipe.loader import WorkflowRecipe, describe_fields, load_recipe, save_recipe
from workflows.recipe.names import known_recipes, known_trainings


@pytest.mark.parametrize("name", sorted(known_recipes()))
def test_every_shipped_recipe_loads_and_describes_itself(name: str) -> None:
    assert load_recipe(name).description


def test_the_papers_training_on_one_gpu() -> None:
    recipe, paper = load_recipe("gpu-paper"), load_recipe("anny-paper", ["training=dsffnet-paper"])
    assert recipe.data == paper.data
    paper.training.require_same_learning(recipe.training.model_copy(update={"precision": "float32"}), where="gpu-paper")
    its = recipe.training
    assert (its.precision, its.compile, its.device, its.launcher) == ("bfloat16", True, "cuda", "inline")
    assert (its.budget, its.evaluate_every, its.checkpoint_every) == ("9min", 2000, 2000)


def test_the_quickstart_is_what_the_readme_says() -> None:
    recipe = load_recipe("quickstart")
    assert recipe.data.identities.training == 16 and recipe.data.poses.seen >= 200
    assert recipe.data.identities.evaluation >= 8 and recipe.data.poses.unseen > 0
    assert recipe.training.ranks == 2 and recipe.training.launcher == "auto"
    assert recipe.beside is not None and (recipe.training.network.name, recipe.beside.network.name) == (
        "dsffnet",
        "parts",
    )


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
        (
            ["trainig.steps=5"],
            r"unknown key 'trainig', did you mean 'training.*\(a recipe has description, data, train",
        ),
        (
            ["data.body={family: mixed, bodies: [{family: anny, topolgy: x}]}"],
            r"unknown key 'data.body.bodies.0.topolgy'",
        ),
        (
            ["data.body={family: clothed, own: [{name: x, parts: [{group: file, pth: a.obj}]}]}"],
            r"unknown key 'data.body.own.0.parts.0.pth', .* \(.* has group, path, geometry, unit, follows, fits, ",
        ),
        (["data.poses.sen=5"], r"unknown key 'data.poses.sen', .* \(data.poses has seen, unseen, distribution, seed\)"),
        (["training.network.name=npt", "training.network.witdh=5"], r"\(training.network has name, variant.*\)\. All"),
        (
            ["data.body={family: leg}", "data.body.phenotypes.age=[0,1]"],
            r"'data.body.phenotypes' is a key of anny, not of the one chosen \(data.body has family, rings, ",
        ),
        (["training.batch=many"], r"training.batch: .*integer.*\(given: 'many'\)"),
        (["training.batch=0"], r"training.batch: .*greater than or equal to 1 \(given: 0\)"),
        (["training.batch=9"], r"batch 9 cannot be shared equally by 2 ranks"),
        (["data.body.family=smurf"], r"data.body.family: 'smurf' is none of anny, smpl, .*mixed\. All keys"),
        (["data.body.family=anyn"], r"data.body.family: 'anyn' is none of .*, did you mean 'anny'\? All keys"),
        (["data.body.phenotypes.age=[0.9,0.1]"], r"data.body.phenotypes: .*age: need 0 <= low <= high <= 1"),
        (["training.budget=20"], r"training.budget: .*'20' is not a time such as 90s, 10min or 2.5h \(given: 20\)"),
        (["training.block=1"], r"training.block: block '1' is not a size such as 500MB or 16GB \(given: 1\)"),
        (["training.steps=true"], r"training: steps: true and false are no values of this key"),
        (["training.network.encoder_widths=[true,8,8]"], r"encoder_widths: true and false are no values"),
        (["training.steps="], r"--set 'training.steps=' has no value after =; write training.steps=null"),
        (["training.steps"], r"--set 'training.steps' is not of the form section.key=value"),
    ],
)
def test_mistakes_are_named(overrides: list[str], message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        load_recipe("dsffnet-small", overrides)


def test_a_network_is_chosen_by_name_and_the_keys_of_another_do_not_stay() -> None:
    chosen = load_recipe("dsffnet-small", ["training.network.name=npt", "training.network.variant=origin"])
    assert chosen.training.network.model_dump() == {
        "name": "npt", "variant": "origin", "encoder_widths": (64, 128, 1024), "norm_weights": "uniform",
    }  # fmt: skip
    plain = load_recipe("dsffnet-small")
    assert (
        load_recipe("dsffnet-small", ["training.network.name=dsffnet"]) == plain
    )  # what no name means: nothing changes
    with pytest.raises(RecipeError, match=r"training.network.name: 'nptt' is none of dsffnet, .*, did you mean 'npt'"):
        load_recipe("dsffnet-small", ["training.network.name=nptt"])
    with pytest.raises(
        RecipeError, match=r"'training.network.decoder_widths' is a key of dsffnet, not of the one chosen \(tr"
    ):
        load_recipe("dsffnet-small", ["training.network.name=npt", "training.network.decoder_widths=[8,8,8]"])


@pytest.mark.parametrize("name", sorted(known_trainings()))
def test_a_published_training_stands_for_the_whole_section_over_any_recipe(name: str) -> None:
    published = load_recipe("dsffnet-small", [f"training={name}"])
    assert published.training == load_recipe("smal-paper", [f"training={name}"]).training
    assert published.data == load_recipe("dsffnet-small").data
    assert published.training.network.model_dump() == type(published.training.network)().model_dump()


def test_published_trainings_are_what_their_sources_say() -> None:
    def chosen(name: str) -> TrainingRecipe:
        return load_recipe("quickstart", [f"training={name}"]).training

    assert chosen("dsffnet-paper") == TrainingRecipe()
    released, npt, corenet = map(chosen, ("dsffnet-released", "npt-paper", "corenet3d-paper"))
    assert (released.learning_rate, released.batch, released.epochs, released.schedule.decay_epochs) == (1e-4, 2, 8, 4)
    assert (released.edge_reference, released.edge_measure) == ("target", "squared_length")
    assert (npt.optimiser, npt.learning_rate, npt.batch, npt.schedule.name) == ("adam", 5e-5, 8, "constant")
    assert (npt.edge_reference, npt.edge_sum, npt.weight_decay) == ("target", "faces", 0)
    assert (corenet.optimiser, corenet.betas, corenet.epsilon, corenet.learning_rate) == ("adam", (0, 0.9), 1e-3, 1e-4)
    assert (corenet.schedule.name, corenet.schedule.hold, corenet.edge_weight) == ("linear", 0.5, 0.5)
    assert corenet.augmentation.shuffle
    # 1,000 times the mean over coordinates is a third of that times the mean over vertices
    assert corenet.reconstruction_weight * 3 == pytest.approx(1000) and npt.reconstruction_weight * 3 == pytest.approx(
        1
    )


@given(st.permutations(["training.steps=100", "training=npt-paper", "training.network.variant=origin"]))
def test_further_overrides_refine_a_published_training_in_any_order(overrides: list[str]) -> None:
    recipe = load_recipe("quickstart", overrides).training
    assert (recipe.steps, recipe.network.name, recipe.learning_rate) == (100, "npt", 5e-5)
    assert recipe.network.variant == "origin"  # type: ignore[union-attr]


def test_a_recipe_file_may_name_a_published_training(tmp_path: Path) -> None:
    (tmp_path / "r.yaml").write_text("{data: {body: {family: leg}}, training: corenet3d-paper}")
    file = str(tmp_path / "r.yaml")
    assert load_recipe(file).training == load_recipe("smoke", ["training=corenet3d-paper"]).training
    assert load_recipe(file, ["training=npt-paper"]).training.network.name == "npt"
    assert load_recipe(file, ["training={steps: 7}"]).training.steps == 7  # values are not a name


@pytest.mark.parametrize(
    "recipe, overrides, message",
    [
        (
            "quickstart",
            ["training=ntp-paper"],
            "no training recipe 'ntp-paper', did you mean 'npt-paper'",
        ),
        ("quickstart", ["training="], "'training=' has no value after ="),
        ("quickstart", ["training=5"], "training: .*given: 5"),
        ("npt-paper", [], "'npt-paper' is a recipe of training only. Add to another: --set training=npt-paper"),
    ],
)
def test_a_training_that_is_none_is_named(recipe: str, overrides: list[str], message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        load_recipe(recipe, overrides)


def test_help_names_the_published_trainings() -> None:
    (line,) = (line for line in describe_fields() if line.startswith("  training = "))
    assert all(name in line for name in known_trainings()) and len(known_trainings()) == 5


def test_what_does_not_fit_together_is_one_line_without_the_whole_section() -> None:
    with pytest.raises(RecipeError) as raised:
        load_recipe("quickstart", ["training.batch=9"])
    assert str(raised.value) == (
        "recipe quickstart: training: batch 9 cannot be shared equally by 2 ranks. All keys: dsffnet recipe --help-all"
    )


@pytest.mark.parametrize("key", ["data.poses.unseen", "data.identities.evaluation", "data.triples.count"])
def test_early_stopping_needs_unseen_poses_to_go_by(key: str) -> None:
    assert load_recipe("smoke", ["training.early_stopping=3"]).training.early_stopping == 3
    with pytest.raises(RecipeError, match=f"recipe smoke: training.early_stopping .* but {key} is 0: set {key}, or"):
        load_recipe("smoke", ["training.early_stopping=3", f"{key}=0"])


def test_unknown_names_and_files(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    with pytest.raises(RecipeError, match=r"mine\.txt is no recipe, which is a file called \.yaml"):
        load_recipe(str(tmp_path / "mine.txt"))
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


@pytest.mark.parametrize("key", sorted(PATH_KEYS))
def test_paths_of_a_training_become_full_whether_they_exist_or_not(
    key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "recipes").mkdir()
    (tmp_path / "recipes" / "r.yaml").write_text(f"training: {{{key}: there}}")

    def found(*overrides: str) -> str:
        return str(getattr(load_recipe("recipes/r.yaml", overrides).training, key))

    assert found() == str(tmp_path / "recipes" / "there")
    assert found(f"training.{key}=here") == found(f"training={{{key}: here}}") == str(tmp_path / "here")
    assert found(f"training.{key}=~/here") == str(Path.home() / "here")
    assert found(f"training.{key}=s3://bucket/here") == "s3://bucket/here"
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:6379")
    with pytest.raises(RecipeError, match=r"'there' is a relative path.*name a full one"):
        found()


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
