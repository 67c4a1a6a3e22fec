"""Cards say what is in the files that they describe, and enough to make both again."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import TypeVar, get_args

import pytest
import torch
import yaml

from datagen.generate import generate
from datagen.recipe import (
    AmassPoses,
    AnatomicalPoses,
    Body,
    ClipPoses,
    DatasetRecipe,
    FilePoses,
    FoundPoses,
    NptPoses,
    RangePoses,
)
from datagen.store import Dataset, open_dataset
from tests.support.recipes import mixed_dataset, tiny_training
from tests.support.workflows import finished_workflow
from training.checkpoints.checkpoint import export_weights, require_checkpoint
from training.evaluation.evaluate import NO_OPS, Row
from training.inference.predict import load_trained
from training.recipes.networks import NETWORK_NAMES
from training.recipes.training import TrainingRecipe
from training.reports.card_texts import FAMILIES, NETWORKS, POSES, family_texts
from training.reports.cards import dataset_card, model_card
from training.reports.report import Block, Code, Facts, Picture, Section, Table, Text
from workflows.pretrained import weights_named

B = TypeVar("B", bound=Block)


@pytest.fixture(scope="module")
def workflow(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Row]]:
    out = tmp_path_factory.mktemp("cards") / "out"
    return out, finished_workflow(_pristine, out)


def all_of(section: Section, kind: type[B]) -> list[B]:
    return [block for block in section.body if isinstance(block, kind)]


def facts_of(section: Section) -> dict[str, str]:
    (facts,) = all_of(section, Facts)
    return {name: fact.text if isinstance(fact, Code) else str(fact) for name, fact in facts.facts.items()}


def text_of(section: Section) -> str:
    return "\n".join(text.markdown for text in all_of(section, Text))


def test_a_dataset_card_says_what_the_dataset_says(dataset: str) -> None:
    opened = open_dataset(dataset)
    facts = facts_of(dataset_card(opened))
    assert (facts["name"], facts["uuid"]) == ("leg.zarr", opened.uuid)
    assert facts["identities"] == "3 (0-2) training, 2 (3-4) evaluation"
    assert (facts["poses"], facts["vertices"]) == ("6 seen, 4 unseen", "32")
    assert facts["faces"] == str(len(opened.faces(0)))
    assert facts["meshes"] == str(3 * 6 + 2 * 10)
    assert facts["sha256 of the manifest"] == opened.attributes["manifest_sha256"]
    (assets,) = all_of(dataset_card(opened), Table)
    assert list(assets.lines[1]) == ["procedural leg", "Apache-2.0", "2"]


def test_the_recipe_on_a_dataset_card_makes_the_same_dataset(dataset: str, tmp_path: Path) -> None:
    opened = open_dataset(dataset)
    recipe = next(code for code in all_of(dataset_card(opened), Code) if code.folded)
    again = generate(DatasetRecipe.model_validate(yaml.safe_load(recipe.text)["data"]), str(tmp_path / "again.zarr"))
    assert again.uuid == opened.uuid
    assert again.attributes["manifest_sha256"] == opened.attributes["manifest_sha256"]


def test_bodies_of_several_counts_are_told_as_a_range(tmp_path: Path) -> None:
    mixed = generate(mixed_dataset(), str(tmp_path / "mixed.zarr"))
    assert facts_of(dataset_card(mixed))["vertices"] == "30 to 32"


def test_a_contact_sheet_is_shown_where_it_is(dataset: str, tmp_path: Path) -> None:
    opened, sheet = open_dataset(dataset), tmp_path / "sheet.png"
    assert not all_of(dataset_card(opened, picture=sheet), Picture)
    sheet.write_bytes(b"a picture")
    assert [picture.path for picture in all_of(dataset_card(opened, picture=sheet), Picture)] == [sheet]


def test_every_family_distribution_and_network_has_its_words() -> None:
    families = {kind.model_fields["family"].default for kind in get_args(get_args(Body)[0])}
    assert set(FAMILIES) == families - {"mixed"}
    sources = (NptPoses, AnatomicalPoses, RangePoses, ClipPoses, AmassPoses, FilePoses, FoundPoses)
    assert set(POSES) == {kind.model_fields["name"].default for kind in sources}
    assert set(NETWORKS) == set(NETWORK_NAMES)
    assert len(family_texts(mixed_dataset().body)) == 1, "a family that comes thrice is told once"


def test_a_card_of_imported_meshes_never_says_that_they_are_nobodys() -> None:
    body = DatasetRecipe.model_validate({"body": {"family": "imported", "path": "faust"}}).body
    (words,) = family_texts(body)
    assert "real people" in words.people and "no person" not in words.people


def test_a_model_card_says_what_the_checkpoint_holds(workflow: tuple[Path, list[Row]]) -> None:
    out, rows = workflow
    facts = facts_of(model_card(out / "run", opened(out), rows))
    checkpoint, (network, _, step) = require_checkpoint(out / "run"), load_trained(out / "run")
    weights = checkpoint.path / "weights.safetensors"
    assert facts["sha256 of the weights"] == hashlib.sha256(weights.read_bytes()).hexdigest()
    assert facts["weights"] == f"{weights.relative_to(out / 'run').as_posix()}, step {step}"
    assert facts["parameters"].split()[0] == f"{sum(each.numel() for each in network.parameters()):,}"
    assert facts["uuid of the data"] == opened(out).uuid
    assert facts["steps"] == "8 of 4 triples each" and facts["precision"] == "float32"


def test_a_card_of_a_network_that_learned_from_rigs_says_so(dataset: str) -> None:
    card = model_card(weights_named("human"), open_dataset(dataset))
    assert "learned from the rigs of its bodies" in facts_of(card)["network"]
    assert "augmentation.subset" in {line[0] for line in all_of(card, Table)[0].lines[1:]}
    assert "poses by one skeleton" in text_of(card)


def test_weights_named_by_their_path_have_a_card_of_their_own(workflow: tuple[Path, list[Row]], tmp_path: Path) -> None:
    out, _ = workflow
    export_weights(require_checkpoint(out / "run"), tmp_path / "exported")
    facts = facts_of(model_card(tmp_path / "exported", opened(out)))
    weights = (tmp_path / "exported" / "weights.safetensors").read_bytes()
    assert facts["sha256 of the weights"] == hashlib.sha256(weights).hexdigest() and "time" not in facts


def test_a_model_of_other_data_is_not_said_to_be_of_this(workflow: tuple[Path, list[Row]], tmp_path: Path) -> None:
    other = generate(mixed_dataset(), str(tmp_path / "mixed.zarr"))
    facts = facts_of(model_card(workflow[0] / "run", other))
    assert "mixed" not in facts["trained on"] and facts["uuid of the data"] == opened(workflow[0]).uuid


def test_changed_fields_stand_first_and_the_whole_recipe_can_be_read_back(workflow: tuple[Path, list[Row]]) -> None:
    card = model_card(workflow[0] / "run", opened(workflow[0]))
    changed = {line[0]: line[1:] for line in all_of(card, Table)[0].lines[1:]}
    assert list(changed["batch"]) == ["4", "8"] and list(changed["schedule.name"]) == ["one_cycle", "step"]
    assert "edge_weight" not in changed and "network.name" not in changed
    whole = next(code for code in all_of(card, Code) if code.folded)
    assert TrainingRecipe.model_validate(yaml.safe_load(whole.text)["training"]) == tiny_training()


def test_results_are_the_models_own_and_failures_those_that_were_measured(workflow: tuple[Path, list[Row]]) -> None:
    out, rows = workflow
    better = [replace(row, pmd=0.0, edge_ratio=9.0) if row.method not in NO_OPS else row for row in rows]
    card = model_card(out / "run", opened(out), better)
    results = all_of(card, Table)[1].lines
    assert [line[:3] for line in results[1:]] == [["seen", "DSFFNet", "0.00"], ["unseen", "DSFFNet", "0.00"]]
    (worse,) = [line for line in text_of(card).splitlines() if "Measured worse" in line]
    assert "edge" in worse and "PMD," not in worse and "PMD (" not in worse
    perfect = [row for row in rows if row.method not in NO_OPS]
    assert "Measured worse" not in text_of(model_card(out / "run", opened(out), perfect))
    assert "Not evaluated yet" in text_of(model_card(out / "run", opened(out)))


def test_a_card_draws_no_random_numbers(workflow: tuple[Path, list[Row]]) -> None:
    torch.manual_seed(3)
    before = torch.get_rng_state()
    model_card(workflow[0] / "run", opened(workflow[0]))
    assert torch.equal(torch.get_rng_state(), before)


def opened(out: Path) -> Dataset:
    return open_dataset(str(out / "dataset.zarr"))
