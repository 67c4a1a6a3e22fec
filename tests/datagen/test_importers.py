"""Finding files of each layout, proposed recipes, and published lists of triples."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.bodies.imported_layouts import find_meshes
from datagen.common.errors import BodyError, RecipeError
from datagen.generate import generate
from datagen.importers import found_recipe, listed_triples, read_test_list, require_files
from datagen.recipe import DatasetRecipe, ImportedBody
from tests.support.shapes.meshes import faust_folder, garment_folder, npt_folder, tetrahedron


def changed(recipe: DatasetRecipe, **sections: dict[str, Any]) -> DatasetRecipe:
    return DatasetRecipe.model_validate(
        {**recipe.model_dump(), **{name: getattr(recipe, name).model_dump() | new for name, new in sections.items()}}
    )


def counts(recipe: DatasetRecipe) -> tuple[int, int, int, int]:
    return recipe.identities.training, recipe.identities.evaluation, recipe.poses.seen, recipe.poses.unseen


@pytest.mark.parametrize(
    "identities, poses, expected",
    [(30, 8, (16, 14, 4, 4)), (17, 5, (15, 2, 3, 2)), (4, 2, (2, 2, 1, 1)), (3, 6, (3, 0, 6, 0)), (1, 1, (1, 0, 1, 0))],
)
def test_npt_recipe_of_a_full_grid(
    tmp_path: Path, identities: int, poses: int, expected: tuple[int, int, int, int]
) -> None:
    folder = npt_folder(tmp_path, identities=range(identities), poses=range(poses))
    recipe = found_recipe("npt", folder)
    assert counts(recipe) == expected
    assert recipe.poses.distribution.name == "found"
    require_files(recipe)


def test_faust_and_multigarment_recipes(tmp_path: Path) -> None:
    faust = found_recipe("faust", faust_folder(tmp_path / "faust"))
    assert counts(faust) == (8, 2, 8, 2)
    assert counts(found_recipe("faust", faust_folder(tmp_path / "five", subjects=range(5)))) == (3, 2, 8, 2)
    garments = found_recipe("multigarment", garment_folder(tmp_path / "garments", ("a", "b", "c")))
    assert counts(garments) == (0, 3, 1, 0)
    dataset = generate(garments, str(tmp_path / "garments.zarr"))
    assert len(dataset.evaluation_triples("seen")) == len(dataset.evaluation_triples("unseen")) == 0
    assert [dataset.vertices(garment).shape[1] for garment in range(3)] == [3, 4, 5]


def test_identities_that_lack_the_same_poses_are_the_training_ones(tmp_path: Path) -> None:
    """As in what a dataset of ours is exported to, also where it has grown: numbers then interleave."""
    for identities, poses in ((range(3), range(4)), (range(3, 5), range(6)), (range(5, 7), range(4))):
        npt_folder(tmp_path, identities=identities, poses=poses)
    recipe = found_recipe("npt", tmp_path)
    assert counts(recipe) == (5, 2, 4, 2)
    assert isinstance(recipe.body, ImportedBody) and recipe.body.identities == ("0", "1", "2", "5", "6", "3", "4")
    require_files(recipe)


def test_a_single_missing_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    folder = npt_folder(tmp_path, identities=range(5), poses=range(4), name="id{}_{}.ply")
    (folder / "id3_2.ply").unlink()
    with pytest.raises(BodyError, match=r"no file id3_2\.ply \(identity 3, pose 2\)"):
        found_recipe("npt", folder)
    assert counts(found_recipe("npt", folder, poses=["0-1", 3])) == (3, 2, 2, 1)


def test_a_recipe_that_asks_for_more_than_there_is(tmp_path: Path) -> None:
    recipe = found_recipe("npt", npt_folder(tmp_path, identities=range(5), poses=range(4)))
    with pytest.raises(RecipeError, match=r"asks for 9 identities or more, but .* has 5"):
        require_files(changed(recipe, identities={"training": 7}))
    with pytest.raises(RecipeError, match=r"asks for 7 poses or more, but .* has 4"):
        require_files(changed(recipe, poses={"unseen": 5}))
    require_files(DatasetRecipe())  # not imported: nothing to look for


def test_imported_sets_that_take_turns_in_a_mixed_dataset(tmp_path: Path) -> None:
    sets = [
        ImportedBody(path=str(npt_folder(tmp_path / name, identities=range(first, first + 2), poses=range(3))))
        for name, first in (("a", 0), ("b", 5))
    ]
    recipe = DatasetRecipe.model_validate(
        {
            "body": {"family": "mixed", "bodies": sets},
            "identities": {"training": 2, "evaluation": 2},
            "poses": {"seen": 2, "unseen": 1, "distribution": {"name": "found"}},
        }
    )
    require_files(recipe)
    dataset = generate(recipe, str(tmp_path / "mixed.zarr"))
    for identity, name in enumerate((0, 5, 1, 6)):
        assert np.array_equal(dataset.vertices(identity, 1), tetrahedron(name, 1))
    with pytest.raises(RecipeError, match=r"asks for 3 identities or more, but .*/a has 2"):
        require_files(changed(recipe, identities={"training": 3}))


def test_a_gap_in_faust_is_an_error_but_whole_subjects_may_be_missing(tmp_path: Path) -> None:
    folder = faust_folder(tmp_path / "registrations", subjects=range(2, 6))
    assert find_meshes(ImportedBody(layout="faust", path=str(tmp_path))).identities == ("2", "3", "4", "5")
    (folder / "tr_reg_034.ply").unlink()
    (folder / "tr_reg_047.ply").unlink()
    with pytest.raises(BodyError, match=r"no file tr_reg_034\.ply, though others of subject 3"):
        find_meshes(ImportedBody(layout="faust", path=str(tmp_path)))


def test_other_files_and_folders_are_passed_over(tmp_path: Path) -> None:
    folder = npt_folder(tmp_path, identities=range(2), poses=range(2))
    for name in ("README.txt", "._0_0.ply", "0_0.ply.bak", "evaluation-seen.txt", "0_0_0.ply"):
        (folder / name).write_text("not a mesh")
    assert len(find_meshes(ImportedBody(path=str(folder))).files) == 4


@pytest.mark.parametrize(
    "options, message",
    [
        ({"path": "{}/nowhere"}, "no folder of meshes at"),
        ({"path": ""}, "no folder of meshes at ''"),
        ({"layout": "faust"}, r"no files called tr_reg_NNN\.ply"),
        ({"layout": "multigarment"}, r"no folders with a file smpl_registered\.obj"),
        ({"identities": [0, 7]}, "data.body.identities: .* has none called 7; it has 0, 1"),
        ({"identities": ["0-1", 1]}, "data.body.identities: 1 is named twice"),
        ({"poses": ["1-9"]}, "data.body.poses: .* has none called 2"),
        ({"poses": ["0-999999999"]}, "data.body.poses: .* has none called 2"),
        ({"identities": ["1-0"]}, r"data.body.identities: the run 1-0 is empty.* Write it 0-1"),
    ],
)
def test_what_is_not_there(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    folder = npt_folder(tmp_path, identities=range(2), poses=range(2))
    values = {"path": str(folder), **options}
    with pytest.raises(BodyError, match=message):
        find_meshes(ImportedBody.model_validate(values | {"path": values["path"].format(folder)}))


def test_two_files_for_one_mesh(tmp_path: Path) -> None:
    npt_folder(tmp_path, identities=range(1), poses=range(1))
    npt_folder(tmp_path, identities=range(1), poses=range(1), name="id{}_{}.ply")
    with pytest.raises(BodyError, match=r"two files for identity 0, pose 0: 0_0\.ply and id0_0\.ply"):
        find_meshes(ImportedBody(path=str(tmp_path)))


@pytest.fixture
def listed(tmp_path: Path) -> Callable[[str], np.ndarray]:
    folder = npt_folder(tmp_path / "files", identities=range(16, 19), poses=range(600, 604), name="id{}_{}.ply")

    def read(text: str) -> np.ndarray:
        (tmp_path / "list.txt").write_text(text)
        return read_test_list(tmp_path / "list.txt", find_meshes(ImportedBody(path=str(folder))))

    return read


def test_a_published_list_in_numbers_of_the_dataset(listed: Callable[[str], np.ndarray]) -> None:
    """Target, source, truth -> source identity, source pose, target identity, target pose."""
    rows = listed("id18_601.ply id16_603.ply id18_603.ply\n\nmeshes/id16_600.ply id16_602.ply id16_602.ply\n")
    assert rows.tolist() == [[0, 3, 2, 1], [0, 2, 0, 0]] and rows.dtype == np.int32


@pytest.mark.parametrize(
    "line, message",
    [
        ("id18_601.ply id16_603.ply", "list.txt, line 2: 2 words instead of the 3"),
        ("id18_601.ply id16_603.ply id18_601.ply", "line 2: the truth id18_601.ply is not the identity of id18_601"),
        ("id18_601.ply id16_603.ply id16_603.ply", "line 2: the truth"),
        ("id18_601.ply id19_603.ply id18_603.ply", "line 2: id19_603.ply is not among the meshes"),
    ],
)
def test_lines_that_are_no_triples(listed: Callable[[str], np.ndarray], line: str, message: str) -> None:
    with pytest.raises(BodyError, match=message):
        listed(f"id18_601.ply id16_603.ply id18_603.ply\n{line}\n")


def test_listed_triples_of_a_recipe(tmp_path: Path) -> None:
    folder = npt_folder(tmp_path / "files", identities=range(2), poses=range(2))
    assert listed_triples(ImportedBody(path=str(folder))) is None
    with pytest.raises(BodyError, match=r"test list .* cannot be read"):
        listed_triples(ImportedBody(path=str(folder), test_list=str(tmp_path / "none.txt")))


@pytest.mark.parametrize("name", ["none.txt", "files", "latin.txt"])
def test_a_test_list_that_cannot_be_read_is_named_before_anything_is_written(tmp_path: Path, name: str) -> None:
    folder = npt_folder(tmp_path / "files", identities=range(4), poses=range(4))
    (tmp_path / "latin.txt").write_bytes(b"\xe4\xff")
    recipe = found_recipe("npt", folder, test_list=str(tmp_path / name))
    with pytest.raises(BodyError, match=rf"the test list .*{name} cannot be read .*--set data.body.test_list=FILE"):
        generate(recipe, str(tmp_path / "out.zarr"))
    assert not (tmp_path / "out.zarr").exists()
