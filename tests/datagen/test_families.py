"""Every family through the whole store: made, checked, mended, appended to, made again from its own attributes."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.common.errors import BodyError, DatasetError
from datagen.generate import append, generate, repair
from datagen.mesh.rig import rest_vertices, skinned, world_rotations
from datagen.recipe import DatasetRecipe
from datagen.store import Dataset, open_dataset
from datagen.store.schema import open_group
from datagen.store.verify import describe, find_faults, require_recipe
from tests.support.files import flip_bit, tree_hash
from tests.support.shapes.bodies import FAMILIES, recipe_parts


def small(parts: dict[str, Any]) -> DatasetRecipe:
    return DatasetRecipe.model_validate(
        {
            "body": parts["body"],
            "identities": {"training": 2, "evaluation": 2},
            "poses": {"seen": 4, "unseen": 2, "distribution": parts["distribution"]},
            "triples": {"count": 3},
            "store": {"poses_per_shard": 3},
        }
    )


def check_rigs(family: str, made: Dataset) -> None:
    """Read from the dataset alone, a rig gives every stored vertex within ten micrometres.

    Vertices at rest are what all poses together say by least squares, so that each has to agree with the others.
    """
    world = world_rotations(made.rotations(), made.attributes["joint_parents"])
    for identity in range(made.grid.identity_count):
        rig = made.rig(identity)
        if family == "imported":
            assert rig is None and not Path(made.url, "rig").exists()
            continue
        assert rig is not None
        stored, transforms = made.vertices(identity), rig.transforms(world[made.grid.poses_of(identity)])
        rest = rest_vertices(stored, rig.weights, transforms)
        labels = made.part(identity)
        assert (labels is not None) == (family == "clothed")
        bare = slice(None) if labels is None else labels == 0
        assert np.abs(skinned(rest, rig.weights, transforms) - stored)[:, bare].max() < 1e-5


@pytest.mark.parametrize("family", FAMILIES)
def test_a_whole_life(family: str, tmp_path: Path) -> None:
    recipe, url = small(recipe_parts(family, tmp_path)), str(tmp_path / "x.zarr")
    made = generate(recipe, url)
    for identity in range(4):
        faces, vertices = made.faces(identity), made.vertices(identity)
        assert vertices.shape[1] == faces.max() + 1 and np.isfinite(vertices).all()
    check_rigs(family, made)
    before = tree_hash(url)

    path = next(shard.path for shard in made.arrays.shards() if 2 in shard.identities and 3 in shard.poses)
    flip_bit(tmp_path / "x.zarr" / path)
    faults = list(find_faults(url))
    assert [fault.path for fault in faults] == [path]
    repair(url, require_recipe(url), faults)
    assert tree_hash(url) == before

    grown = append(url, evaluation=4, unseen=3)
    again = generate(require_recipe(url), str(tmp_path / "again.zarr"))
    assert tree_hash(url) == tree_hash(tmp_path / "again.zarr") and grown.uuid == again.uuid
    check_rigs(family, grown)
    assert describe(url)["appended"] == "2 evaluation, 1 unseen"


def test_inspect_shows_the_parts_of_a_body_as_a_tree(tmp_path: Path) -> None:
    url = str(tmp_path / "x.zarr")
    generate(small(recipe_parts("rigged", tmp_path)), url)
    tree = "Hips (Spine (Neck (Head)), Leg.L (Foot.L), Leg.R (Foot.R))"
    assert describe(url)["rig"] == f"8 parts: {tree}; other rigs of 8 parts"


def test_a_triple_may_take_its_source_from_one_body_and_its_target_from_another(tmp_path: Path) -> None:
    made = generate(small(recipe_parts("mixed", tmp_path)), str(tmp_path / "x.zarr"))
    assert [made.parameters(identity)[0] for identity in range(4)] == [0, 1, 0, 1]
    source, _, target, _ = made.evaluation_triples("unseen").T
    assert set(source % 2) == {0, 1} and (source % 2 != target % 2).all()


def test_another_model_file_is_refused_but_a_moved_one_is_not(tmp_path: Path) -> None:
    parts, url = recipe_parts("smpl", tmp_path), str(tmp_path / "x.zarr")
    before = generate(small(parts), url).attributes["manifest_sha256"]
    moved = shutil.move(parts["body"]["path"], tmp_path / "elsewhere.npz")
    recipe = small({**parts, "body": {**parts["body"], "path": str(moved)}})
    open_group(url, mode="r+").update_attributes({"status": "building"})
    found = generate(recipe, url)
    assert found.attributes["manifest_sha256"] == before and found.recipe == recipe, "and the new path is kept"

    with np.load(moved) as arrays:
        changed = dict(arrays)
    changed["v_template"] = changed["v_template"] * 1.001
    np.savez(moved, **changed)
    from datagen.bodies import load_body

    load_body.cache_clear()
    open_group(url, mode="r+").update_attributes({"status": "building"})
    with pytest.raises(DatasetError, match=r"was made from .*sha256:.*, but here is .*sha256:"):
        generate(recipe, url)


def test_poses_of_other_animals_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    parts = {"body": recipe_parts("rigged", tmp_path)["body"], "distribution": {"name": "npt"}}
    with pytest.raises(BodyError, match="'rigged' lacks"):
        generate(small(parts), str(tmp_path / "x.zarr"))
    assert not (tmp_path / "x.zarr").exists()


def test_too_few_files_to_append_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    url = str(tmp_path / "x.zarr")
    generate(small(recipe_parts("imported", tmp_path)), url)
    before = tree_hash(url)
    with pytest.raises(Exception, match="asks for 9 identities or more"):
        append(url, evaluation=7)
    assert tree_hash(url) == before and open_dataset(url).grid.identity_count == 4
