"""Dressed people beside bare ones in a dataset: made the same by any process, exported, described and drawn."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from datagen.bodies.clothed.model import ClothedModel
from datagen.common.errors import DatasetError, MeshError
from datagen.exporters import export_dataset
from datagen.generate import generate
from datagen.generate.plan import plan_of
from datagen.mesh.files import load_mesh, read_mesh_file
from datagen.mesh.formats.gltf import Gltf
from datagen.mesh.parts import part_colors
from datagen.recipe import DatasetRecipe
from datagen.store import Dataset
from datagen.store.schema import open_group
from datagen.store.verify import describe
from tests.support.files import tree_hash
from tests.support.layout import layout
from tests.support.shapes.bodies import recipe_parts
from training.reports.contact_sheet import draw_contact_sheet

ROOT = Path(__file__).parents[4]


def recipe(**changes: Any) -> DatasetRecipe:
    """Two identities of ``clothed`` (a skirt, loose clothes) and, between them, two bare ones, in two poses and one."""
    bodies = [recipe_parts(family, Path())["body"] for family in ("clothed", "anny")]
    values: dict[str, Any] = {
        "body": {"family": "mixed", "bodies": bodies},
        "identities": {"training": 3, "evaluation": 1},
        "poses": {"seen": 2, "unseen": 1},
        "triples": {"count": 2},
        "store": {"poses_per_shard": 1},
    }
    return DatasetRecipe.model_validate(values | changes)


@pytest.fixture(scope="module")
def people(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return generate(recipe(), str(tmp_path_factory.mktemp("people") / "mixed.zarr"))


def test_the_plan_counts_vertices_without_draping_anybody(monkeypatch: pytest.MonkeyPatch, people: Dataset) -> None:
    monkeypatch.setattr(ClothedModel, "vertices", lambda *_: pytest.fail("draped"))
    assert plan_of(recipe()).arrays.vertices == people.arrays.vertices


def test_labels_are_stored_of_dressed_identities_alone_and_as_documented(people: Dataset) -> None:
    for identity in range(4):
        labels = people.part(identity)
        assert (labels is None) == (identity % 2 == 1)
        assert labels is None or np.array_equal(np.unique(labels), [0, 1, 2])
    found, numbers = layout(people.url), people.arrays.topologies.tolist()
    assert [name for name in found if name.endswith("/part")] == [f"topology/{n}/part" for n in sorted(numbers[::2])]
    assert people.attributes["labelled"] == sorted(numbers[::2])
    count = people.vertex_count(0)
    assert found[f"topology/{numbers[0]}/part"] == {
        **found["grid/topology"], "shape": [count], "dimension_names": ["vertex"],
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [count]}},
    }  # fmt: skip


def test_glb_has_a_geometry_and_a_material_a_part(people: Dataset, tmp_path: Path) -> None:
    export_dataset(people, tmp_path, layout="glb", poses=[1])
    dressed, bare = (tmp_path / f"identity-000{identity}/pose-0001.glb" for identity in (0, 1))
    names = ["skin", "garment 1", "garment 2"]
    read = read_mesh_file(dressed)
    assert list(read.geometries) == names and [its["name"] for its in Gltf(dressed).json["materials"]] == names
    looks = [its["pbrMetallicRoughness"]["baseColorFactor"] for its in Gltf(dressed).json["materials"]]
    assert np.ptp(looks, axis=0)[:3].min() > 0.1, "three colours"
    assert np.array_equal(read.mesh.vertices.astype(np.float32), people.vertices(0, 1))
    assert np.array_equal(read.mesh.faces, people.faces(0))
    labels = people.part(0)
    assert labels is not None
    garment = read_mesh_file(dressed, geometries=["garment 2"]).mesh
    assert np.array_equal(garment.vertices.astype(np.float32), people.vertices(0, 1)[labels == 2])
    assert len(read_mesh_file(bare).geometries) == 1


def test_an_animated_glb_goes_through_the_poses(people: Dataset, tmp_path: Path) -> None:
    assert export_dataset(people, tmp_path, layout="glb-animated", identities=[0, 3]) == 2
    assert export_dataset(people, tmp_path, layout="glb-animated", identities=[0, 3]) == 0
    with pytest.raises(DatasetError, match="holds other files than an export"):
        export_dataset(people, tmp_path, layout="glb-animated", identities=[0, 3], poses=[0])
    for identity, poses, geometries in ((0, 2, 3), (3, 3, 1)):
        path = tmp_path / f"identity-000{identity}.glb"
        file = Gltf(path)
        (animation,) = file.json["animations"]
        assert len(animation["channels"]) == geometries == len(file.json["meshes"])
        times = file.accessor(animation["samplers"][0]["input"])
        assert np.allclose(times.ravel(), np.arange(poses) / 2)
        assert np.array_equal(load_mesh(path).vertices.astype(np.float32), people.vertices(identity, 0))
        moves = [file.accessor(its["primitives"][0]["targets"][0]["POSITION"]) for its in file.json["meshes"]]
        second = people.vertices(identity, 0) + np.concatenate(moves)
        assert np.abs(second - people.vertices(identity, 1)).max() < 1e-6


def test_an_animation_of_too_many_poses_is_refused_before_any_is_read(
    people: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("datagen.exporters.FRAME_LIMIT", 2)
    monkeypatch.setattr(Dataset, "vertices", None)
    with pytest.raises(MeshError, match="3 poses of an identity are more than 2"):
        export_dataset(people, tmp_path / "out", layout="glb-animated", identities=[0, 3])
    assert not (tmp_path / "out").exists()


def test_obj_has_a_group_a_part_but_not_for_peers(people: Dataset, tmp_path: Path) -> None:
    export_dataset(people, tmp_path / "obj", layout="obj", identities=[0], poses=[0])
    path = tmp_path / "obj/identity-0000/pose-0000.obj"
    groups = [line for line in path.read_text().splitlines() if line.startswith("g ")]
    assert groups == ["g skin", "g garment-1", "g garment-2"]
    assert np.array_equal(load_mesh(path).faces, people.faces(0))
    export_dataset(people, tmp_path / "npt", layout="npt-obj", identities=[0], poses=[0])
    assert "\ng " not in (tmp_path / "npt/0_0.obj").read_text()


def test_inspect_tells_the_parts_and_draws_them_in_their_colours(people: Dataset, tmp_path: Path) -> None:
    labels = [people.part(identity) for identity in (0, 2)]
    skin = sorted(int((its == 0).sum()) for its in labels if its is not None)
    told = describe(people.url)["clothes"]
    assert told.startswith(f"2 identities are dressed; 2 in 2 garments (vertices: skin {skin[0]:,} to {skin[1]:,}, ")
    picture = imread(draw_contact_sheet(people, tmp_path / "sheet.png"))[..., :3]
    bright = picture[picture.max(axis=2) - picture.min(axis=2) > 0.1]
    for color in part_colors(np.array([0, 1, 2])) / 255:  # shading darkens a colour and keeps its hue
        hue = bright / np.linalg.norm(bright, axis=1, keepdims=True) @ (color / np.linalg.norm(color))
        assert (hue > 0.999).sum() > 300, color


@pytest.mark.slow
def test_another_process_gives_every_second_shard_the_same_bytes(people: Dataset, tmp_path: Path) -> None:
    """Who drapes, and what was draped before, is not to be seen; that holds for whatever is killed, and on Ray."""
    url = Path(shutil.copytree(people.url, tmp_path / "mixed.zarr"))
    open_group(str(url), mode="r+").attrs["status"] = "building"
    for shard in people.arrays.shards()[1::2]:
        (url / shard.path).unlink()
    program = (
        "from datagen.generate import generate; from tests.datagen.bodies.clothed.test_clothed_dataset import recipe;"
        "import sys; generate(recipe(), sys.argv[1])"
    )
    subprocess.run([sys.executable, "-c", program, str(url)], cwd=ROOT, check=True)
    assert tree_hash(url) == tree_hash(people.url)


def test_the_memory_of_every_worker_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    from datagen import sizes
    from datagen.common.errors import RecipeError

    monkeypatch.setattr(sizes, "free_memory", lambda: 1_500_000_000)
    sizes.require_memory(recipe())
    with pytest.raises(RecipeError, match=r"takes about 1\.8 GB of memory, .* Lower the number of workers$"):
        sizes.require_memory(recipe(), workers=2)
