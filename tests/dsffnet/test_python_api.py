"""``dsffnet.transfer``: what the command writes, from paths, trimesh objects and arrays; light to import."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from datagen.mesh.files import load_mesh, save_mesh
from datagen.mesh.geometry import Mesh
from datagen.store import open_dataset
from dsffnet import DsffnetError, DsffnetWarning, transfer
from dsffnet.posed import _of_python
from tests.support.commands import ROOT
from tests.support.recipes import tiny_training
from training.engine.trainer import train
from workflows.cli import main as cli


@pytest.fixture(scope="module")
def run(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny run, and in its folder pose.ply and person.ply."""
    folder, dataset = tmp_path_factory.mktemp("api"), open_dataset(str(_pristine))
    train(tiny_training(), data=dataset.url, run=folder / "run")
    for name, identity, pose in (("pose", 3, 7), ("person", 4, 0)):
        save_mesh(Mesh(dataset.vertices(identity, pose), dataset.faces(identity)), folder / f"{name}.ply")
    return folder / "run"


@pytest.mark.parametrize("options", [{}, {"refine": True}, {"align": True}, {"up": "Z", "front": "-Y"}])
def test_the_bits_of_the_command(run: Path, tmp_path: Path, options: dict[str, str | bool]) -> None:
    pose, person = run.parent / "pose.ply", run.parent / "person.ply"
    words = [f"--{key}" if value is True else f"--{key}={value}" for key, value in options.items()]
    given = cli.parsed(["transfer", str(pose), str(person), "-o", str(tmp_path / "a.ply"), "--model", str(run), *words])
    given.command(given)
    transfer(pose, person, model=run, **options).export(tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_paths_objects_and_arrays_are_alike(run: Path, tmp_path: Path) -> None:
    pose, person = (load_mesh(run.parent / f"{name}.ply") for name in ("pose", "person"))
    body = trimesh.Trimesh(person.vertices, person.faces, process=False)
    before = body.vertices.copy()
    by_path = transfer(run.parent / "pose.ply", run.parent / "person.ply", model=run)
    by_value = transfer((pose.vertices.tolist(), pose.faces), body, model=str(run))
    assert np.array_equal(by_path.vertices, by_value.vertices) and np.array_equal(by_path.faces, by_value.faces)
    assert np.array_equal(body.vertices, before) and not np.allclose(by_value.vertices, before, atol=1e-3)
    for name in ("posed.obj", "posed.ply", "posed.glb", "posed.off", "posed.stl"):
        by_value.export(tmp_path / name)
        assert len(load_mesh(tmp_path / name).faces) == len(person.faces)
    assert np.allclose(load_mesh(tmp_path / "posed.obj").vertices, by_path.vertices, atol=1e-6)


def test_one_line_for_whatever_is_wrong(run: Path, tmp_path: Path) -> None:
    pose, good = run.parent / "pose.ply", load_mesh(run.parent / "person.ply")
    flat = good.vertices * [1, 1, 0]
    wrong = [
        ((good.vertices, [[0, 1, 10**6]]), "target: faces name vertex 1000000, but there are"),
        ((good.vertices * np.nan, good.faces), "target: .* vertices are not finite"),
        ((flat, good.faces), "target is flat: it has no thickness along z"),
        ((np.concatenate([flat, [[0, 0, 5]]]), good.faces), "target is flat: it has no thickness along z"),
        (tmp_path / "no.obj", "no.obj"),
        (7, "target is a int"),
        ((torch.tensor(good.vertices, requires_grad=True), good.faces), "target is a tuple; .*requires grad"),
        ((good.vertices + 1j, good.faces), "target: its vertices are complex128, not real numbers"),
        ((good.vertices, good.faces + 0.5), "target: its faces are float64, not whole numbers"),
        ((good.vertices, np.ones((4, 3), bool)), "target: its faces are bool, not whole numbers"),
        ((good.vertices, np.zeros((5, 4), int)), r"target has faces of shape \(5, 4\), not triangles \[f, 3\]"),
        ((good.vertices, []), r"target has no faces \(shape \(0, 3\)\); triangles are needed"),
        (np.array(good.vertices), r"target has no faces"),
    ]
    for given, said in wrong:
        with pytest.raises(DsffnetError, match=said) as error:
            transfer(pose, given, model=run)
        assert "\n" not in str(error.value)
    for model, said in (
        (tmp_path / "no-run", "no such run or weights"),
        ("", "'': there is no such run or weights"),
        (5, "model=5 is no path or name of weights"),
    ):
        with pytest.raises(DsffnetError, match=said):
            transfer(pose, pose, model=model)
    with pytest.raises(DsffnetError, match=r"up=5 is no text; name an axis, as in up='Z'"):
        transfer(pose, pose, model=run, up=5)
    with pytest.raises(DsffnetError, match="align finds how the meshes stand"):
        transfer(pose, pose, model=run, align=True, up="Z")
    with pytest.raises(DsffnetError, match="never written over"):
        transfer(pose, pose, model=run).export(pose)


def test_messages_speak_of_arguments(run: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    pose, said = run.parent / "pose.ply", list[str]()
    good = load_mesh(pose)
    apart = trimesh.Scene({str(x): trimesh.Trimesh(good.vertices + x, good.faces, process=False) for x in (0, 9)})
    apart.export(tmp_path / "apart.glb")
    for given, options in (
        (pose, {"up": "X,Y,Z"}),
        (pose, {"model": "no-run"}),
        (pose, {"model": "models:/dsffnet@best"}),
        (pose, {"model": run, "force": True}),
        (apart, {"model": run}),
        (tmp_path / "apart.glb", {"model": run}),
    ):
        with pytest.raises(DsffnetError) as error:
            transfer(pose, given, **options)
        said.append(str(error.value))
    with pytest.raises(DsffnetError) as error:
        transfer(pose, pose, model=run).export(pose)
    said.append(str(error.value))
    assert "--" not in " ".join(said) and len(set(said)) == 7
    assert said[0] == "up='X,Y,Z', front='Z': name one axis, or two with a comma, of source and target"
    assert said[2].endswith("set MLFLOW_TRACKING_URI") and said[4].startswith("target holds 2 geometries")
    assert said[-1].endswith("choose another path")
    advice = "add --align, or --up=Z,Y --front=-Y,Z: or add --force; look at --picture"
    assert _of_python(advice) == "add align=True, or up='Z,Y', front='-Y,Z': or add force=True; look at it"
    assert _of_python("State --up=Z") == "State up='Z'"
    advice = "look at --picture, and try --refine or --model dressed"
    assert _of_python(advice) == "look at it, and try refine=True or model='dressed'"


def test_a_source_may_be_points(run: Path) -> None:
    pose, good = run.parent / "pose.ply", load_mesh(run.parent / "person.ply")
    expected = transfer((good.vertices, good.faces), pose, model=run).vertices  # this network sees vertices alone
    layout = SimpleNamespace(vertices=good.vertices, triangles=good.faces)
    for points in (
        (good.vertices, []),
        (good.vertices, None),
        trimesh.PointCloud(good.vertices),
        good.vertices,
        layout,
    ):
        np.testing.assert_allclose(transfer(points, pose, model=run).vertices, expected, atol=1e-6)


def test_what_is_doubtful_is_a_warning_that_code_can_see(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ball = trimesh.creation.icosphere(2)
    with pytest.warns(DsffnetWarning, match="source .*The result may be poor"):
        posed = transfer(ball, run.parent / "person.ply", model=run)
    assert posed.doubts and not capsys.readouterr().err


def test_a_scene_is_posed_as_one_body(run: Path) -> None:
    person = load_mesh(run.parent / "person.ply")
    body, scene = trimesh.Trimesh(person.vertices, person.faces, process=False), trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.3, [0, 1, 0])
    scene.add_geometry(body.copy().apply_transform(np.linalg.inv(turn)), node_name="body", transform=turn)
    scene.add_geometry(trimesh.creation.icosphere(1, radius=0.05), node_name="hat")
    scene.add_geometry(trimesh.points.PointCloud(np.eye(3)), node_name="marks")
    posed = transfer(run.parent / "pose.ply", scene, model=run)
    assert len(posed.vertices) == len(person.vertices) + 42 and np.array_equal(
        posed.faces[: len(person.faces)], person.faces
    )
    alone = trimesh.Scene({"body": body})
    expected = transfer(run.parent / "pose.ply", run.parent / "person.ply", model=run)
    assert np.allclose(transfer(run.parent / "pose.ply", alone, model=run).vertices, expected.vertices, atol=1e-6)
    with pytest.raises(DsffnetError, match="source is a scene that shows no triangles"):
        transfer(trimesh.Scene(), scene, model=run)


def test_importing_it_brings_no_heavy_package() -> None:
    heavy = {"torch", "numpy", "trimesh", "mlflow", "ray", "zarr"}
    code = f"import sys, dsffnet; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
