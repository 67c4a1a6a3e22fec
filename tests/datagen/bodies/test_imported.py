"""Imported meshes as a body model: numbers, frames, faults of files, and a dataset made of them."""

from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from datagen.bodies import BodyModel, load_body, require_joints
from datagen.bodies.imported import ImportedModel, frame
from datagen.common.errors import BodyError, DatasetError, MeshError, RecipeError
from datagen.generate import generate, repair
from datagen.importers import found_recipe
from datagen.mesh.files import save_mesh
from datagen.mesh.geometry import Mesh
from datagen.poses import Poses, draw_poses, load_poses
from datagen.recipe import ImportedBody, LegBody, PoseRecipe
from datagen.store.verify import find_faults
from tests.support.files import flip_bit, tree_hash
from tests.support.shapes.meshes import FACES, faust_folder, garment_folder, npt_folder, save, tetrahedron

FOUND = PoseRecipe.model_validate({"seen": 3, "unseen": 0, "distribution": {"name": "found"}})


def body_of(folder: Path, **options: Any) -> BodyModel:
    return load_body(ImportedBody.model_validate({"path": str(folder), **options}))


def read(body: BodyModel, identity: int, poses: range) -> np.ndarray:
    parameters = body.draw_identity(np.random.default_rng(0), identity)
    return body.vertices(parameters, draw_poses(FOUND, poses))


def test_found_poses_carry_their_number_to_the_imported_body_alone(tmp_path: Path) -> None:
    assert draw_poses(FOUND, range(5, 8)).rotations.tolist() == [[[5, 0, 0]], [[6, 0, 0]], [[7, 0, 0]]]
    body = body_of(npt_folder(tmp_path, identities=range(2), poses=range(2)))
    require_joints(body, load_poses(FOUND), family="imported")
    with pytest.raises(BodyError, match="joints that the body family 'imported' lacks"):
        require_joints(body, load_poses(PoseRecipe()), family="imported")
    with pytest.raises(BodyError, match="number"):
        require_joints(load_body(LegBody()), load_poses(FOUND), family="leg")
    with pytest.raises(BodyError, match="name=found"):
        body.vertices(np.zeros(1), draw_poses(PoseRecipe(), range(1)))


@pytest.mark.parametrize("name", ["{}_{}.obj", "id{}_{}.obj", "toy_{}_{}.ply", "{:03d}_{:04d}.ply"])
def test_npt_files_are_numbered_by_their_place_among_the_numbers(tmp_path: Path, name: str) -> None:
    body = body_of(npt_folder(tmp_path, identities=range(9, 12), poses=range(98, 102), name=name))
    vertices = read(body, 1, range(1, 4))  # 10 and 11 come after 9, 100 after 99
    assert np.array_equal(vertices, [tetrahedron(10, pose) for pose in (99, 100, 101)])
    assert vertices.dtype == np.float32
    assert np.array_equal(body.faces(np.array([1.0])), FACES)


def test_identities_and_poses_can_be_chosen_and_ordered(tmp_path: Path) -> None:
    folder = npt_folder(tmp_path, identities=range(6), poses=range(5))
    body = body_of(folder, identities=["4-5", 0], poses=[3, "0-1"])
    assert np.array_equal(read(body, 2, range(3)), [tetrahedron(0, pose) for pose in (3, 0, 1)])
    assert np.array_equal(read(body, 0, range(1)), [tetrahedron(4, 3)])
    with pytest.raises(RecipeError, match=r"asks for 4 identities or more, but .* has 3"):
        read(body, 3, range(1))
    with pytest.raises(RecipeError, match=r"asks for 4 poses or more, but .* has 3"):
        read(body, 0, range(4))


def test_faust_registrations_are_ten_poses_of_each_subject(tmp_path: Path) -> None:
    faust_folder(tmp_path / "training" / "registrations", subjects=range(3, 5))
    body = body_of(tmp_path, layout="faust")
    assert np.array_equal(read(body, 1, range(10)), [tetrahedron(4, pose) for pose in range(10)])


def test_garments_have_a_topology_each(tmp_path: Path) -> None:
    body = body_of(garment_folder(tmp_path, ("125611", "125612", "126111")), layout="multigarment")
    assert [read(body, garment, range(1)).shape for garment in range(3)] == [(1, 3, 3), (1, 4, 3), (1, 5, 3)]
    assert [len(body.faces(np.array([garment]))) for garment in range(3)] == [1, 2, 3]


@pytest.mark.parametrize(
    "up, forward, point, expected",
    [
        ("y", "z", [1, 2, 3], [1, 2, 3]),
        ("z", "-y", [1, 2, 3], [1, 3, -2]),  # Blender, Anny
        ("z", "x", [1, 2, 3], [2, 3, 1]),
        ("-y", "-z", [1, 2, 3], [1, -2, -3]),  # camera axes
    ],
)
def test_axes_are_turned_to_ours(
    tmp_path: Path, up: str, forward: str, point: list[float], expected: list[float]
) -> None:
    vertices = np.array([point, [0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    save_mesh(Mesh(vertices, FACES), tmp_path / "0_0.ply")
    assert read(body_of(tmp_path, up=up, forward=forward), 0, range(1))[0, 0].tolist() == expected
    in_metres = read(body_of(tmp_path, up=up, forward=forward, unit=0.01), 0, range(1))[0, 0]
    assert np.allclose(in_metres, np.array(expected) / 100)


def test_no_choice_of_axes_mirrors() -> None:
    names = [sign + axis for sign in ("", "-") for axis in "xyz"]
    for up, forward in permutations(names, 2):
        if up[-1] != forward[-1]:
            columns, signs = frame(up, forward)  # type: ignore[arg-type]
            assert np.linalg.det(np.eye(3)[columns] * signs[:, None]) == 1, (up, forward)
    with pytest.raises(ValidationError, match="lie along one axis"):
        ImportedBody(up="y", forward="-y")


def test_a_pose_with_other_vertices_or_faces_names_its_file(tmp_path: Path) -> None:
    folder = npt_folder(tmp_path, identities=range(1), poses=range(3))
    save_mesh(Mesh(np.vstack([tetrahedron(0, 1), [[9, 9, 9]]]), np.vstack([FACES, [[0, 1, 4]]])), folder / "0_1.ply")
    save_mesh(Mesh(tetrahedron(0, 2), FACES[:, ::-1]), folder / "0_2.ply")
    with pytest.raises(BodyError, match=r"0_1\.ply has 5 vertices, the identity's first file 4"):
        read(body_of(folder), 0, range(2))
    with pytest.raises(BodyError, match=r"0_2\.ply has other faces"):
        read(body_of(folder), 0, range(2, 3))


def test_missing_broken_and_loose_files_are_named(tmp_path: Path) -> None:
    folder = npt_folder(tmp_path, identities=range(2), poses=range(3), name="id{}_{}.ply")
    (folder / "id1_1.ply").unlink()
    (folder / "id1_2.ply").write_bytes(b"ply\nnot really")
    with pytest.raises(BodyError, match=r"no file id1_1\.ply \(identity 1, pose 1\)"):
        read(body_of(folder), 1, range(3))
    with pytest.raises(MeshError, match=r"id1_2\.ply.*Repair the file, or leave out .*data\.body\.identities=\["):
        read(body_of(folder), 1, range(2, 3))
    (tmp_path / "loose").mkdir()
    (tmp_path / "loose" / "0_0.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 5 5 5\nf 1 2 3\n")
    with pytest.raises(BodyError, match=r"0_0\.obj: its last 1 vertices are in no face"):
        body_of(tmp_path / "loose").faces(np.zeros(1))


def test_the_asset_is_a_hash_of_all_files_wherever_they_lie(tmp_path: Path) -> None:
    def version(folder: Path, **options: Any) -> str:  # not load_body, which reads a set once a process
        return ImportedModel(ImportedBody.model_validate({"path": str(folder), **options})).assets[0].version

    here = npt_folder(tmp_path / "here", identities=range(2), poses=range(2))
    there = npt_folder(tmp_path / "there", identities=range(2), poses=range(2))
    assert version(here) == version(there) != version(here, poses=[0])
    save(there / "1_1.ply", 1, 5)
    assert version(here) != version(there)
    (tmp_path / "list.txt").write_text("0_0.ply 1_1.ply 0_1.ply\n")
    listed = body_of(here, test_list=str(tmp_path / "list.txt")).assets
    assert [asset.name for asset in listed] == ["npt meshes (4 files)", "evaluation list"]


def test_paths_do_not_count_in_the_hash_of_a_recipe(tmp_path: Path) -> None:
    recipes = [
        found_recipe("npt", npt_folder(tmp_path / name, identities=range(5), poses=range(4)), test_list=name)
        for name in ("a", "b")
    ]
    assert recipes[0] != recipes[1] and recipes[0].sha256() == recipes[1].sha256()
    assert recipes[0].sha256() != recipes[0].model_copy(update={"body": ImportedBody(unit=0.5)}).sha256()


def test_no_poses_are_no_meshes(tmp_path: Path) -> None:
    body = body_of(npt_folder(tmp_path, identities=range(1), poses=range(1)))
    assert body.vertices(np.zeros(1), Poses(("number",), (-1,), np.empty((0, 1, 3)))).shape == (0, 4, 3)


def test_a_dataset_of_imported_meshes_is_like_any_other(tmp_path: Path) -> None:
    """Faces and vertices are the files'; it is whole; a damaged shard is made again, byte for byte."""
    folder = npt_folder(tmp_path / "files", identities=range(3, 9), poses=range(10, 16), name="{}_{}.obj")
    recipe, url = found_recipe("npt", folder), str(tmp_path / "imported.zarr")
    dataset = generate(recipe, url)
    assert dataset.identities("training") == [0, 1, 2, 3] and dataset.identities("evaluation") == [4, 5]
    for identity in range(dataset.grid.identity_count):
        for pose in dataset.grid.poses_of(identity):
            expected = tetrahedron(3 + identity, 10 + int(pose))
            assert dataset.vertices(identity, int(pose)).tobytes() == expected.tobytes()
        assert np.array_equal(dataset.faces(identity), FACES)
    before = tree_hash(url)
    (shard,) = (shard for shard in dataset.arrays.shards() if 4 in shard.identities)
    flip_bit(Path(url) / shard.path)
    faults = list(find_faults(url))
    assert [fault.path for fault in faults if fault.shard] == [shard.path]
    assert len(repair(url, recipe, faults).evaluation_triples("unseen")) == 400
    assert tree_hash(url) == before


def test_files_that_changed_are_not_mixed_into_a_dataset(tmp_path: Path) -> None:
    folder = npt_folder(tmp_path / "files", identities=range(4), poses=range(4))
    recipe, url = found_recipe("npt", folder), str(tmp_path / "imported.zarr")
    generate(recipe, url)
    next(Path(url).glob("grid/evaluation/0/vertices/c/0/0/0/0")).unlink()
    save(folder / "3_3.ply", 7, 7)
    load_body.cache_clear()
    with pytest.raises(DatasetError, match="npt meshes"):
        generate(recipe, url)
