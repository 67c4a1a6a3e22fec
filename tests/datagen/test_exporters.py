"""Exports: names, lists, going on after an interruption, full disks, and the way back in."""

from pathlib import Path

import numpy as np
import pytest

from datagen.common.errors import DatasetError, RecipeError, StorageError
from datagen.exporters import ExportLayout, export_dataset
from datagen.generate import generate
from datagen.importers import found_recipe, listed_triples
from datagen.mesh.files import load_mesh
from datagen.recipe import ImportedBody
from datagen.store import open_dataset
from tests.support.disk import small_disk
from tests.support.files import tree_hash
from tests.support.recipes import tiny_dataset

MESHES = 3 * 6 + 2 * 10  # of the tiny dataset


@pytest.mark.parametrize("layout", ["npt-obj", "npt-ply"])
def test_what_is_exported_and_imported_again_is_the_same_bit_for_bit(
    dataset: str, tmp_path: Path, layout: ExportLayout
) -> None:
    ours = open_dataset(dataset)
    assert export_dataset(ours, tmp_path / "files", layout=layout, prefix="id") == MESHES
    recipe = found_recipe("npt", tmp_path / "files")
    theirs = generate(recipe, str(tmp_path / "again.zarr"))
    assert theirs.identities("training") == ours.identities("training")
    for identity in range(ours.grid.identity_count):
        assert theirs.vertices(identity).tobytes() == ours.vertices(identity).tobytes()
        assert np.array_equal(theirs.faces(identity), ours.faces(identity))
    for pose_type in ("seen", "unseen"):
        listed = ImportedBody.model_validate(
            {"path": str(tmp_path / "files"), "test_list": str(tmp_path / "files" / f"evaluation-{pose_type}.txt")}
        )
        assert np.array_equal(listed_triples(listed), ours.evaluation_triples(pose_type))  # type: ignore[arg-type]


def test_npt_obj_is_plain_vertices_and_faces(dataset: str, tmp_path: Path) -> None:
    """Peers' readers know v and f lines only, and count from 1."""
    data = open_dataset(dataset)
    export_dataset(data, tmp_path, layout="npt-obj", identities=[4], poses=[7])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["4_7.obj", "README.txt"]
    lines = [line.split() for line in (tmp_path / "4_7.obj").read_text().splitlines()]
    vertices = np.array([words[1:] for words in lines if words[0] == "v"], np.float32)
    faces = np.array([words[1:] for words in lines if words[0] == "f"], np.int32)
    assert len(vertices) + len(faces) == len(lines)
    assert np.array_equal(vertices, data.vertices(4, 7)) and np.array_equal(faces - 1, data.faces(4))


@pytest.mark.parametrize("layout", ["obj", "ply", "glb"])
def test_folders_for_people(dataset: str, tmp_path: Path, layout: ExportLayout) -> None:
    data = open_dataset(dataset)
    assert export_dataset(data, tmp_path, layout=layout, identities=[0, 3], poses=range(5, 10)) == 1 + 5
    found = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob(f"*.{layout}"))
    assert found[0] == f"identity-0000/pose-0005.{layout}" and found[-1] == f"identity-0003/pose-0009.{layout}"
    mesh = load_mesh(tmp_path / found[-1])
    assert np.array_equal(mesh.vertices.astype(np.float32), data.vertices(3, 9))
    assert np.array_equal(mesh.faces, data.faces(3))
    assert "metres" in (tmp_path / "README.txt").read_text() and "Y up" in (tmp_path / "README.txt").read_text()


def test_an_export_goes_on_where_it_stopped(dataset: str, tmp_path: Path) -> None:
    data = open_dataset(dataset)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    export_dataset(data, whole, layout="npt-obj")
    assert export_dataset(data, parts, layout="npt-obj", progress=lambda cells: cells[:7]) == 7
    marked = parts / "0_2.obj"
    marked.write_text(marked.read_text() + "# there already\n")
    assert export_dataset(data, parts, layout="npt-obj") == MESHES - 7
    assert marked.read_text().endswith("# there already\n")
    assert export_dataset(data, parts, layout="npt-obj", fresh=True) == MESHES
    assert tree_hash(parts) == tree_hash(whole)


def test_what_a_killed_export_left_is_removed_by_the_next(dataset: str, tmp_path: Path) -> None:
    data, kept = open_dataset(dataset), tmp_path / ".mine.partial"
    export_dataset(data, tmp_path, layout="glb", identities=[0], poses=[0])
    left = [
        tmp_path / ".README.txt.0123456789abcdef.partial",
        tmp_path / "identity-0000" / ".a.glb.0123456789abcdef.partial",
    ]
    for path in (kept, *left):
        path.touch()
    export_dataset(data, tmp_path, layout="glb", identities=[0], poses=[0])
    assert kept.exists() and not any(path.exists() for path in left)


def test_lists_name_files_that_are_there_alone(dataset: str, tmp_path: Path) -> None:
    data = open_dataset(dataset)
    export_dataset(data, tmp_path, layout="npt-ply", identities=[3, 4], poses=range(5))
    names = (tmp_path / "evaluation-seen.txt").read_text().split()
    assert names and all((tmp_path / name).is_file() for name in names)
    assert len(names) < 3 * len(data.evaluation_triples("seen"))


def test_a_folder_of_something_else_is_left_alone(dataset: str, tmp_path: Path) -> None:
    data = open_dataset(dataset)
    other = generate(tiny_dataset(identities={"training": 1, "evaluation": 1, "seed": 5}), str(tmp_path / "other.zarr"))
    export_dataset(other, tmp_path / "files", layout="glb")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "0_0.obj").write_text("my own")
    for folder in ("files", "mine"):
        before = tree_hash(tmp_path / folder)
        with pytest.raises(DatasetError, match="holds other files than an export of this dataset"):
            export_dataset(data, tmp_path / folder, layout="glb", fresh=True)
        assert tree_hash(tmp_path / folder) == before


def test_what_cannot_be_exported(dataset: str, tmp_path: Path) -> None:
    data = open_dataset(dataset)
    with pytest.raises(RecipeError, match="no layout 'fbx'"):
        export_dataset(data, tmp_path, layout="fbx")  # type: ignore[arg-type]
    with pytest.raises(RecipeError, match="no identity 5 to export; the dataset's are 0 to 4"):
        export_dataset(data, tmp_path, layout="obj", identities=[5])
    with pytest.raises(RecipeError, match="no pose -1"):
        export_dataset(data, tmp_path, layout="obj", poses=[-1])
    with pytest.raises(RecipeError, match="nothing to export"):
        export_dataset(data, tmp_path, layout="obj", identities=[0], poses=[9])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("prefix", ["../evil", "a/b", "/tmp/x", "id\n", "a b", ".hidden", "\u00e4"])
def test_a_prefix_stays_within_the_folder(dataset: str, tmp_path: Path, prefix: str) -> None:
    with pytest.raises(RecipeError, match=r"prefix .* cannot begin the names of files"):
        export_dataset(open_dataset(dataset), tmp_path / "files", layout="npt-obj", prefix=prefix)
    assert not list(tmp_path.iterdir())


def test_a_place_that_is_no_folder_says_what_to_do(dataset: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(DatasetError, match=r"file is a file, .* Choose another: --out FOLDER"):
        export_dataset(open_dataset(dataset), tmp_path / "file", layout="obj")
    with pytest.raises(StorageError, match=r"could not write .*choose another folder \(--out\)"):
        export_dataset(open_dataset(dataset), tmp_path / "file" / "below", layout="obj")


def test_a_full_disk_leaves_whole_files_and_room_lets_it_go_on(dataset: str, tmp_path: Path) -> None:
    data = open_dataset(dataset)
    with small_disk(tmp_path / "disk", kibibytes=64) as disk:
        with pytest.raises(
            StorageError, match=r"could not write .*make room or choose another folder .*same command again"
        ):
            export_dataset(data, disk / "files", layout="npt-obj")
        files = list((disk / "files").glob("*.obj"))
        assert 0 < len(files) < MESHES
        for path in files:
            load_mesh(path)
        assert not list((disk / "files").glob(".*"))
