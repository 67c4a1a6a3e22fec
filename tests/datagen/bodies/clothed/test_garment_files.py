"""Garments from mesh files: fitted to the person that they were made for, worn by others, refused in one line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from datagen.bodies import load_body
from datagen.bodies.clothed.draping import depths
from datagen.bodies.clothed.model import ClothedModel, body_faces
from datagen.common.errors import BodyError, DatasetError
from datagen.common.files import sha256_of
from datagen.exporters import export_dataset
from datagen.generate import generate
from datagen.mesh.files import read_mesh_file, save_mesh
from datagen.mesh.geometry import Mesh, closest_on_triangle
from datagen.poses import JOINTS, PARENTS, Poses
from datagen.recipe import ClothedBody, DatasetRecipe
from datagen.store import open_dataset
from tests.support.shapes.bodies import COARSE
from workflows.recipe.loader import load_recipe

ROOT = Path(__file__).parents[4]
ADULT = (0.5, 0.67, 0.5, 0.5, 0.5, 0.5)
CHILD = (0.5, 0.35, 0.5, 0.5, 0.5, 0.5)
SKIRT, SHIRT = "identity-0005/pose-0000.obj", "identity-0003/pose-0000.obj"
BODY = {"family": "anny", "topology": COARSE, "phenotypes": {"age": [0, 1]}}
SOLVER = {"frames": 8, "substeps": 8, "settle": 60, "subdivide": 0}


@pytest.fixture(scope="module")
def rest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the commands of docs/bodies/clothed.md write."""
    folder = tmp_path_factory.mktemp("garments")
    recipe = load_recipe("clothed-rest", []).data
    export_dataset(generate(recipe, str(folder / "rest.zarr")), folder / "rest", layout="obj", identities=[0, 3, 5])
    return folder


def documented() -> dict[str, Any]:
    """The body of the recipe in docs/bodies/clothed.md that has a garment from a file."""
    text = (ROOT / "docs/bodies/clothed.md").read_text(encoding="utf-8")
    (block,) = (its for its in text.split("\n\n") if its.startswith("    data:") and "group: file" in its)
    body: dict[str, Any] = yaml.safe_load(block)["data"]["body"]
    return body


def dressed(part: dict[str, Any], **changes: Any) -> ClothedModel:
    own = [{"name": "mine", "parts": [{"group": "file", **part}]}]
    recipe = {"body": BODY, "outfits": ["mine"], "own": own, "solver": SOLVER, **changes}
    body = load_body(ClothedBody.model_validate(recipe))
    assert isinstance(body, ClothedModel)
    return body


def skirt(path: Path) -> dict[str, Any]:
    return {"path": str(path), "geometry": "garment-2", "follows": "skirt"}


def stride() -> Poses:
    turns = np.zeros((2, len(JOINTS), 3))
    turns[1, [JOINTS.index("left_hip"), JOINTS.index("right_hip")], 0] = -0.6, 0.4
    return Poses(JOINTS, PARENTS, turns)


def test_a_built_in_garment_that_is_exported_and_read_back_drapes_as_it_did(
    rest: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The documented recipe, on the person that its file was made for: within millimetres, but for a few folds."""
    monkeypatch.chdir(rest)
    body = {**documented(), "body": BODY, "solver": SOLVER}
    mine, parameters = load_body(ClothedBody.model_validate(body)), np.array([*ADULT, 0, 1.0])
    built_in = load_body(ClothedBody.model_validate({"body": BODY, "outfits": ["skirt"], "solver": SOLVER}))
    assert isinstance(mine, ClothedModel) and isinstance(built_in, ClothedModel)
    here, there = (model.person(tuple(parameters)).garment for model in (mine, built_in))
    assert np.array_equal(here.faces, there.faces) and np.array_equal(here.pinned, there.pinned)
    assert np.linalg.norm(here.rest.vertices - there.rest.vertices, axis=1).mean() < 0.002
    one, other = (model.vertices(parameters, stride()) for model in (mine, built_in))
    labels = mine.part_labels(parameters)
    apart = np.linalg.norm(one - other, axis=2)[:, labels == 2]
    assert apart.mean() < 0.008 and np.percentile(apart, 95) < 0.025


def test_it_is_worn_by_other_people_and_known_by_its_hash(rest: Path) -> None:
    model = dressed(skirt(rest / "rest" / SKIRT))
    assert f"sha256:{sha256_of(rest / 'rest' / SKIRT)}" in [asset.version for asset in model.assets]
    statures = []
    for who in (ADULT, CHILD):
        person = model.person((*who, 0, 1.0))
        places = person.garment.rest.vertices
        assert depths(places.astype(np.float32), person.body.vertices.astype(np.float32), body_faces()).max() < 0.003
        statures.append(np.ptp(places[:, 1]) / np.ptp(person.body.vertices[:, 1]))
        draped = model.vertices(np.array([*who, 0, 1.0]), stride())
        assert np.isfinite(draped).all()
    assert abs(statures[0] / statures[1] - 1) < 0.1


def test_skin_below_a_shirt_is_left_out_and_that_of_a_skirt_kept(rest: Path) -> None:
    shirt = {"path": str(rest / "rest" / SHIRT), "geometry": "garment-2", "pins": ["top", "sleeves"]}
    parameters = np.array([*ADULT, 0, 1.0])
    whole = load_body(ClothedBody.model_validate({"body": BODY}).body).faces(parameters)
    below, kept = (dressed(its, method="skinned").person(tuple(parameters)).skin_faces
                   for its in (shirt, skirt(rest / "rest" / SKIRT)))  # fmt: skip
    assert 0.5 * len(whole) < len(below) < 0.9 * len(whole) and len(kept) == len(whole)
    garment = dressed(shirt, method="skinned").person(tuple(parameters)).garment
    assert garment.pinned.sum() > 40 and len(np.unique(garment.pinned)) == 2


def test_a_file_that_is_cut_at_seams_in_centimetres_or_inside_out_is_the_same_garment(
    rest: Path, tmp_path: Path
) -> None:
    mesh = _mesh(rest)
    seams = Mesh(100 * mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3)[:, ::-1])
    save_mesh(seams, tmp_path / "seams.ply")
    parameters = (*ADULT, 0, 1.0)
    one = dressed(skirt(rest / "rest" / SKIRT), method="skinned").person(parameters).garment
    other = dressed({"path": str(tmp_path / "seams.ply"), "unit": 0.01, "follows": "skirt"}, method="skinned")
    found = other.person(parameters).garment
    assert len(found.faces) == len(one.faces) and found.pinned.sum() == one.pinned.sum()
    assert np.allclose(found.rest.vertices.mean(axis=0), one.rest.vertices.mean(axis=0), atol=1e-5)


def _mesh(rest: Path) -> Mesh:
    """The skirt [vertex, 3], alone, with the vertices that it uses."""
    mesh = read_mesh_file(rest / "rest" / SKIRT, geometries=["garment-2"]).mesh
    used, faces = np.unique(mesh.faces, return_inverse=True)
    return Mesh(np.asarray(mesh.vertices)[used], faces.reshape(-1, 3))


def _with_a_fin(mesh: Mesh) -> Mesh:
    a, b, _ = mesh.faces[300]
    return Mesh(np.concatenate([mesh.vertices, [mesh.vertices[a] + 0.1]]),
                np.concatenate([mesh.faces, [[a, b, len(mesh.vertices)]]]))  # fmt: skip


def _closed(mesh: Mesh) -> Mesh:
    turned = mesh.faces[:, ::-1] + len(mesh.vertices)
    inner = Mesh(np.concatenate([mesh.vertices, 0.99 * mesh.vertices]), np.concatenate([mesh.faces, turned]))
    sides = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    _, first, counts = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
    a, b = sides[first[counts == 1]].T
    count = len(mesh.vertices)
    bridge = np.concatenate([np.stack([b, a, a + count], 1), np.stack([b, a + count, b + count], 1)])
    return Mesh(inner.vertices, np.concatenate([inner.faces, bridge]))


def _one_turned(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, np.concatenate([mesh.faces[:1, ::-1], mesh.faces[1:]]))


def _flat(mesh: Mesh) -> Mesh:
    vertices = mesh.vertices.copy()
    a, b, c = mesh.faces[300]
    vertices[a] = (vertices[b] + vertices[c]) / 2
    return Mesh(vertices, mesh.faces)


def _twice(mesh: Mesh) -> Mesh:
    return Mesh(np.concatenate([mesh.vertices, mesh.vertices + 0.01]),
                np.concatenate([mesh.faces, mesh.faces + len(mesh.vertices)]))  # fmt: skip


def _moved(mesh: Mesh, scale: float = 1.0, shift: float = 0.0, order: tuple[int, ...] = (0, 1, 2)) -> Mesh:
    return Mesh(scale * np.asarray(mesh.vertices)[:, order] + [0, shift, 0], mesh.faces)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_with_a_fin, r"is not manifold: 1 edges have more than two faces, the first at \(.*\) m\. A garment"),
        (_closed, r"is closed: nobody gets in\. Remove the inner layer, or open"),
        (_one_turned, r"has faces that are turned both ways\. Let the normals of all look outwards"),
        (_flat, r"has 1 faces without an area\. Dissolve them"),
        (_twice, r"is in 2 pieces\. Make each a part of the outfit"),
        (lambda mesh: _moved(mesh, 100), r"is 79\.\d m across, where .* If it is in centimetres, say unit: 0\.01"),
        (lambda mesh: _moved(mesh, 1000), r"is 791 m across, where .* If it is in millimetres, say unit: 0\.001"),
        (lambda mesh: _moved(mesh, 0.01), r"is 0\.\d+ m across, where .* say unit: 100$"),
        (lambda mesh: _moved(mesh, 0.001), r"is 0\.\d+ m across, where .* say unit: 1000$"),
        (lambda mesh: _moved(mesh, shift=2.0), r"is not on the body: half of its vertices are more than 1\.\d+ m from "
         r"the skirt of the person under fits\. Files are in metres, Y up, facing \+Z, in the T-pose"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_worn_is_refused_with_what_to_do(
    rest: Path, tmp_path: Path, change: Callable[[Mesh], Mesh], message: str
) -> None:
    save_mesh(change(_mesh(rest)), tmp_path / "my-skirt.ply")
    part = {"path": str(tmp_path / "my-skirt.ply"), "follows": "skirt"}
    with pytest.raises(BodyError, match=r"^my-skirt\.ply \(part 1 of the outfit 'mine'\) " + message):
        dressed(part)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({}, r"no file \(part 1 of the outfit 'mine'\): path is empty\. Name the garment's file under data\.body\.own"),
        ({"path": "nowhere.obj"}, r"the garment of nowhere\.obj \(part 1 .*\) cannot be read: .*nowhere\.obj"),
        ({"path": "{rest}/" + SKIRT, "geometry": "garment-7"}, r"cannot be read: .*garment-7"),
        ({"path": "{rest}/" + SKIRT, "geometry": "garment-2", "pins": []}, r"part 1 of the outfit \(file\) hangs on "),
    ],
)
def test_parts_that_name_no_garment_are_refused(rest: Path, part: dict[str, Any], message: str) -> None:
    told = {**part, "path": part.get("path", "").format(rest=rest / "rest")}
    with pytest.raises(BodyError, match=message):
        dressed(told).faces(np.array([*ADULT, 0, 1.0]))


def test_too_many_vertices_are_refused(rest: Path) -> None:
    with pytest.raises(BodyError, match=r"has 13,7\d\d vertices, 21\d,\d\d\d once subdivided 2 times .* Simplify it"):
        dressed({"path": str(rest / "rest/identity-0000/pose-0000.obj")}, solver={**SOLVER, "subdivide": 2})


def test_a_file_within_the_body_beyond_repair_is_refused(rest: Path, tmp_path: Path) -> None:
    mesh = _mesh(rest)
    inside = Mesh(mesh.vertices * [0.3, 1, 0.3], mesh.faces)
    save_mesh(inside, tmp_path / "narrow.obj")
    body = dressed({"path": str(tmp_path / "narrow.obj"), "follows": "skirt"})
    with pytest.raises(BodyError, match=r"of the outfit 'mine' are more than 10 mm inside of the body at rest"):
        body.faces(np.array([*ADULT, 0, 1.0]))


def test_the_place_of_a_file_is_not_part_of_a_dataset_but_its_bytes_are(rest: Path, tmp_path: Path) -> None:
    def recipe(path: Path) -> DatasetRecipe:
        own = [{"name": "mine", "parts": [{"group": "file", **skirt(path)}]}]
        body = {"family": "clothed", "body": BODY, "outfits": ["mine"], "own": own, "method": "skinned"}
        values = {"body": body, "identities": {"training": 1, "evaluation": 0}, "triples": {"count": 0}}
        return DatasetRecipe.model_validate({**values, "poses": {"seen": 1, "unseen": 0}})

    here, there, other = rest / "rest" / SKIRT, tmp_path / "elsewhere.obj", tmp_path / "other.obj"
    there.write_bytes(here.read_bytes())
    other.write_bytes(here.read_bytes() + b"# another\n")
    assert recipe(here).sha256() == recipe(there).sha256()
    url = str(tmp_path / "x.zarr")
    generate(recipe(here), url)
    assert "elsewhere" not in str(open_dataset(url).attributes)
    generate(recipe(there), url)
    with pytest.raises(DatasetError, match=r"was made from part 1 of the outfit 'mine' sha256:.* but here is"):
        generate(recipe(other), url)


def test_the_nearest_place_on_a_triangle_is_within_it_on_a_side_or_at_a_corner() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    points = np.array([[0.2, 0.3, 5], [0.5, -1, 0], [-1, -1, 1], [1, 1, 0]])
    expected = [[0.5, 0.2, 0.3], [0.5, 0.5, 0], [1, 0, 0], [0, 0.5, 0.5]]
    assert np.allclose(closest_on_triangle(points, np.broadcast_to(corners, (4, 3, 3))), expected)
