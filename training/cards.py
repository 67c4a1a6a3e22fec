"""Cards: what a dataset and a trained model are, what they are for, and where they end. Parts of a report."""

import shlex
from pathlib import Path

from datagen.store import Dataset
from datagen.store.verify import describe
from training.card_texts import DATASET_LIMITS, DATASET_USE, POSES, as_yaml, family_texts, name_of, span, vertex_counts
from training.model_card import model_card
from training.report_blocks import Block, Code, Facts, Picture, Section, Table, Text

__all__ = ["CONTACT_SHEET", "dataset_card", "model_card"]

CONTACT_SHEET = "generate/contact-sheet.png"


def dataset_card(dataset: Dataset, *, picture: Path | None = None) -> Section:
    """What a dataset holds, what it was made from and how to make it again, what it is for, and where it ends.

    ``picture``: its contact sheet; by default the one that a workflow leaves beside the dataset, where it is there.
    """
    name, recipe = name_of(dataset), dataset.recipe
    sheet = picture or Path(dataset.url).parent / CONTACT_SHEET
    texts = family_texts(recipe.body)
    limits = DATASET_LIMITS.format(
        people="; ".join(text.people for text in texts),
        unlike="; ".join(text.unlike for text in texts),
        poses=POSES[recipe.poses.distribution.name],
    )
    body: list[Block] = [Facts(_dataset_facts(dataset))]
    if sheet.is_file():
        body.append(Picture(sheet, "Some identities (lines) in some poses (columns), both spread over the whole grid."))
    body += [
        _assets(dataset, [text.source for text in texts]),
        Text(f"### Intended use\n\n{DATASET_USE}\n\n### Limits\n\n{limits}\n\n### To make it again"),
        Code(f"dsffnet generate --recipe {shlex.quote(name)} --out AGAIN.zarr\ndsffnet verify AGAIN.zarr"),
        Code(as_yaml({"data": recipe.identifying()}), folded="Its recipe (paths of asset files left out)"),
    ]
    return Section("Dataset card", tuple(body))


def _dataset_facts(dataset: Dataset) -> dict[str, str | int | float | Code]:
    recipe, found = dataset.recipe, describe(dataset.url)
    faces = [len(dataset.faces(identity)) for identity in range(dataset.grid.identity_count)]
    options = recipe.poses.distribution.model_dump(mode="json", exclude={"name", "path", "degrees"})
    words = ", ".join(f"{key} {value}" for key, value in options.items() if value not in ([], ""))
    poses = f"{recipe.poses.distribution.name} ({words})" if words else recipe.poses.distribution.name
    joints = len(dataset.attributes["joints"])
    seeds = f"identities {recipe.identities.seed}, poses {recipe.poses.seed}, triples {recipe.triples.seed}"
    facts: dict[str, str | int | float | Code] = {
        "name": name_of(dataset),
        "uuid": Code(dataset.uuid),
        "body": found["body"],
        "vertices": span(vertex_counts(dataset)),
        "faces": span(faces),
        "identities": found["identities"],
        "poses": f"{len(dataset.grid.poses('seen')):,} seen, {len(dataset.grid.poses('unseen')):,} unseen",
        "appended": found.get("appended", ""),
        "pose distribution": f"{poses}; {joints} joints" if joints else poses,
        "seeds": seeds,
        "evaluation triples": found["evaluation triples"],
        "meshes": f"{dataset.attributes['statistics']['meshes']:,}",
        "size": f"{dataset.attributes['statistics']['bytes'] / 1e6:,.1f} MB on the disk",
        "extent": found["extent"],
        "units and frame": f"{dataset.attributes['units']}; {dataset.attributes['frame']}",
        "made with": found["packages"],
        "made by commit": Code(found["git commit"]),
        "sha256 of the recipe": Code(found["recipe sha256"]),
        "sha256 of the manifest": Code(dataset.attributes["manifest_sha256"]),
    }
    return {name: fact for name, fact in facts.items() if fact != ""}


def _assets(dataset: Dataset, sources: list[str]) -> Table:
    assets = dataset.attributes["body"]["assets"]
    lines = [[asset["name"], asset["licence"], asset["version"]] for asset in assets]
    notes = f"Where bodies come from: {'; '.join(sources)}."
    return Table([["made from", "licence", "version or sha256"], *lines], "Assets", notes)
