"""The registered model: arrays or files in, the options of ``dsffnet transfer``, and models that cannot be had."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mlflow
import numpy as np
import pytest

from datagen.bodies import load_body
from datagen.common.errors import MeshError, RecipeError, RegistryError
from datagen.common.seeding import Stream, generator
from datagen.generate import generate
from datagen.mesh.files import read_mesh_file, save_mesh
from datagen.mesh.geometry import Mesh
from datagen.poses import draw_poses
from datagen.recipe import AnnyBody, PoseRecipe
from tests.support.recipes import tiny_dataset
from tests.support.workflows import untrained_run
from training.inference.orientation import EVERY_AXES, Axes, Orientation
from training.inference.registered_model import PoseTransferModel, download_weights
from training.inference.transfer import PoseTransfer
from workflows.pretrained import own_weights


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, and a mesh in the wanted pose and one of the wanted identity."""
    folder = tmp_path_factory.mktemp("registered")
    dataset = generate(tiny_dataset(), str(folder / "leg.zarr"))
    untrained_run(folder / "run")
    save_mesh(Mesh(dataset.vertices(3, 7), dataset.faces(3)), folder / "pose.obj")
    save_mesh(Mesh(dataset.vertices(4, 0), dataset.faces(4)), folder / "person.obj")
    return folder


@pytest.fixture(scope="module")
def model(folder: Path) -> PoseTransferModel:
    made = PoseTransferModel()
    made.load_context(SimpleNamespace(artifacts={"weights": str(folder / "run")}))
    return made


@pytest.fixture(scope="module")
def arrays(folder: Path) -> dict[str, Any]:
    source, target = (read_mesh_file(folder / name).mesh for name in ("pose.obj", "person.obj"))
    return {"source": source.vertices, "target": target.vertices, "target_faces": target.faces}


def files(folder: Path) -> dict[str, str]:
    return {"source": str(folder / "pose.obj"), "target": str(folder / "person.obj")}


def test_arrays_and_files_give_what_the_command_gives(
    model: PoseTransferModel, folder: Path, arrays: dict[str, Any]
) -> None:
    target = Mesh(arrays["target"], arrays["target_faces"])
    source = read_mesh_file(folder / "pose.obj").mesh
    expected = PoseTransfer.from_run(folder / "run")(source=source, target=target).vertices
    assert np.allclose(model.predict(None, arrays), expected, atol=1e-6)
    assert np.allclose(model.predict(None, files(folder)), expected, atol=1e-6)


def test_a_source_of_points_is_what_it_is_without_faces(
    model: PoseTransferModel, folder: Path, arrays: dict[str, Any]
) -> None:
    (folder / "points.obj").write_text("".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in arrays["source"].tolist()))
    of_file = model.predict(None, files(folder) | {"source": str(folder / "points.obj")})
    assert np.array_equal(of_file, model.predict(None, arrays))


def test_the_parts_network_reads_a_source_without_faces_as_points() -> None:
    body = load_body(AnnyBody(topology="notoes_collapse5pc"))
    who = body.draw_identity(generator(7, Stream.IDENTITY, 0), 0)
    source, target = body.vertices(who, draw_poses(PoseRecipe(seed=7), range(2)))
    made = PoseTransferModel()
    made.load_context(SimpleNamespace(artifacts={"weights": str(own_weights("human"))}))
    given = {"source": source, "target": target, "target_faces": body.faces(who)}
    found = made.predict(None, given)
    whole = Mesh(target, body.faces(who))
    transfer, no_faces = PoseTransfer.from_run(own_weights("human")), np.empty((0, 3), np.int64)
    of_points = transfer(source=Mesh(source, no_faces), target=whole).vertices
    of_mesh = transfer(source=Mesh(source, body.faces(who)), target=whole).vertices
    assert np.allclose(found, of_points, atol=1e-6) and not np.allclose(found, of_mesh, atol=1e-6)
    assert np.array_equal(found, made.predict(None, given | {"source_faces": []}))


def test_refining_and_axes_are_those_of_the_command(
    model: PoseTransferModel, folder: Path, arrays: dict[str, Any]
) -> None:
    transfer, axes = PoseTransfer.from_run(folder / "run"), Axes("Z", "-Y")
    source, target = (read_mesh_file(path).mesh for path in files(folder).values())
    refined = transfer(source=source, target=target, refine=6.0).vertices
    assert np.allclose(model.predict(None, files(folder), {"refine": 6.0}), refined, atol=1e-6)
    lying = arrays | {"target": axes.restored(arrays["target"])}
    found = model.predict(None, lying, {"up": "Y,Z", "front": "Z,-Y"})
    assert np.array_equal(model.predict(None, lying, {"up": "Y,Z"}), found), "where Z is up, -Y is the front"
    assert np.allclose(axes.turned(found), model.predict(None, arrays), atol=1e-5)


def test_aligning_turns_each_mesh_as_it_is_found_to_stand(
    model: PoseTransferModel, arrays: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    axes = Axes("Z", "-Y")
    is_best = np.arange(24) == EVERY_AXES.index(axes)
    ways = {True: Orientation(1.0 - is_best, np.ones(2)), False: Orientation(np.ones(24), np.ones(2))}
    lying = arrays | {"target": axes.restored(arrays["target"])}
    monkeypatch.setattr(
        "training.inference.registered_model.orientation",
        lambda errors, meshes: ways[bool((meshes[0] == lying["target"]).all())],
    )
    with pytest.warns(UserWarning, match="how the source stands is not certain: it is taken as it lies"):
        found = model.predict(None, lying, {"align": True})
    assert np.allclose(axes.turned(found), model.predict(None, arrays), atol=1e-5)


def test_unusable_input_is_one_clear_error(model: PoseTransferModel, folder: Path, arrays: dict[str, Any]) -> None:
    with pytest.raises(MeshError, match="source: 1 vertex is not finite"):
        model.predict(None, arrays | {"source": np.where(np.arange(3) == 1, np.nan, arrays["source"][:1])})
    with pytest.raises(MeshError, match="target: faces name vertex"):
        model.predict(None, arrays | {"target_faces": arrays["target_faces"] + 1000})
    with pytest.raises(MeshError, match="target_faces"):
        model.predict(None, {key: arrays[key] for key in ("source", "target")})
    with pytest.raises(MeshError, match=r"no mesh file at .*none\.obj"):
        model.predict(None, arrays | {"source": str(folder / "none.obj")})
    with pytest.raises(RecipeError, match="'W' is no axis"):
        model.predict(None, arrays, {"up": "W"})
    with pytest.raises(RecipeError, match="'refined' is no option"):
        model.predict(None, arrays, {"refined": 6.0})


def test_models_that_cannot_be_had(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("MLFLOW_TRACKING_URI", "MLFLOW_REGISTRY_URI"):
        monkeypatch.setenv(name, "")
    uri = "models:/dsffnet@latest-trained"
    with pytest.raises(RegistryError, match=r"no MLflow store .*none\.db"):
        download_weights(uri, f"sqlite:///{tmp_path / 'none.db'}", tmp_path / "to")
    assert not list(tmp_path.iterdir()), "no store is made by asking"
    before = mlflow.get_tracking_uri()
    with pytest.raises(RegistryError, match=f"{uri} cannot be had from MLflow at ftp:"):
        download_weights(uri, "ftp://nowhere", tmp_path / "to")
    assert mlflow.get_tracking_uri() == before and not os.environ["MLFLOW_REGISTRY_URI"]
    mlflow.set_tracking_uri(f"sqlite:///{tmp_path / 'other.db'}")
    assert mlflow.get_registry_uri() == mlflow.get_tracking_uri(), "the registry follows the process's server still"
    mlflow.set_tracking_uri(before)
