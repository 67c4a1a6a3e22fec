"""``dsffnet skin``: what comes out moves as the field around the body says, and opens as a rigged character."""

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.bodies import load_body
from datagen.characters.character import load_character
from datagen.common.errors import DsffnetError
from datagen.generate.identities import identity_parameters
from datagen.mesh.files import load_mesh, save_mesh
from datagen.mesh.geometry import Mesh, vertex_normals
from datagen.mesh.rig import part_transforms, skinned
from datagen.poses import JOINTS, PARENTS, Poses
from datagen.recipe import DatasetRecipe, LegBody
from tests.support.shapes.skinned_files import SkinnedFile
from training.avatar.diffusion import thin_plate
from workflows.cli.main import parsed
from workflows.transfer.skin import SkinJob


def job(*words: str | Path) -> SkinJob:
    given = parsed(["skin", *map(str, words)])
    return SkinJob(given.body, given.set, given.identity, mesh=given.mesh, out=given.out, body_mesh=given.body_mesh)


def run(*words: str | Path) -> list[str]:
    made = job(*words)
    made.check()
    return made.run()


@pytest.fixture
def sock(tmp_path: Path) -> Path:
    """The leg's own surface, two centimetres out: what is worn over it."""
    run("--body", "leg", "--identity", "2", "--body-mesh", tmp_path / "leg.ply")
    leg = load_mesh(tmp_path / "leg.ply")
    out = leg.vertices + 0.02 * vertex_normals(leg.vertices, leg.faces)
    save_mesh(Mesh(out.astype(np.float32), leg.faces), tmp_path / "sock.obj")
    return tmp_path / "sock.obj"


def bent(file: SkinnedFile, degrees: float) -> NDArray[np.float64]:
    return file.posed({"left_knee": Rotation.from_euler("x", degrees, degrees=True).as_matrix()})


def test_the_file_moves_as_the_field_says(sock: Path, tmp_path: Path) -> None:
    said = run(sock, "--body", "leg", "--identity", "2", "--out", tmp_path / "sock.glb")
    assert said[0].startswith(str(tmp_path / "sock.glb")) and "288 vertices on 2 bones" in said[0]
    file, body = SkinnedFile(tmp_path / "sock.glb"), job("--body", "leg", "--identity", "2").resting_body()
    assert file.names == ["left_hip", "left_knee"]
    turns = np.stack([np.eye(3), Rotation.from_euler("x", 70, degrees=True).as_matrix()])
    extent = float(np.ptp(body.vertices, axis=0).max())
    weights = thin_plate(body, offset=0.006 * extent).weights(file.positions)
    expected = skinned(file.positions, weights, part_transforms(turns, body.joints, body.parents)[None])[0]
    assert bent(file, 70) == pytest.approx(expected, abs=1e-5)


def test_what_is_worn_stays_around_the_body_that_bends(sock: Path, tmp_path: Path) -> None:
    run(sock, "--body", "leg", "--identity", "2", "--out", tmp_path / "sock.glb")
    model, recipe = load_body(LegBody()), DatasetRecipe(body=LegBody())
    rotations = np.zeros((1, len(JOINTS), 3))
    rotations[0, JOINTS.index("left_knee"), 0] = np.radians(40)
    leg = model.vertices(identity_parameters(recipe, model, 2), Poses(JOINTS, PARENTS, rotations))[0]
    away = np.linalg.norm(bent(SkinnedFile(tmp_path / "sock.glb"), 40) - leg, axis=1)
    assert 0.01 < np.median(away) < 0.03 and away.max() < 0.06


def test_a_rigged_file_is_a_body_too_and_what_is_written_is_one(sock: Path, tmp_path: Path) -> None:
    run(sock, "--body", "leg", "--identity", "2", "--out", tmp_path / "sock.glb")
    character = load_character(tmp_path / "sock.glb")
    assert character.names == ("left_hip", "left_knee") and len(character.vertices) == 288
    run(sock, "--body", tmp_path / "sock.glb", "--out", tmp_path / "again.glb")
    first, again = (SkinnedFile(tmp_path / f"{name}.glb") for name in ("sock", "again"))
    assert again.names == first.names and np.abs(bent(again, 50) - bent(first, 50)).max() < 0.01


def test_a_mesh_in_another_pose_is_warned_of_with_a_measure(
    sock: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ("--body", "leg", "--identity", "2", "--out", tmp_path / "sock.glb")
    run(sock, *words)
    assert capfd.readouterr() == ("", ""), "neither a warning nor a word of Warp's"
    model, recipe = load_body(LegBody()), DatasetRecipe(body=LegBody())
    rotations = np.zeros((1, len(JOINTS), 3))
    rotations[0, JOINTS.index("left_knee"), 0] = np.radians(60)
    who = identity_parameters(recipe, model, 2)
    leg = model.vertices(who, Poses(JOINTS, PARENTS, rotations))[0]
    save_mesh(Mesh(leg.astype(np.float32), model.faces(who)), tmp_path / "bent.obj")
    run(tmp_path / "bent.obj", *words)
    found = re.search(
        r"warning: a tenth of .*bent\.obj is (\d+) cm or more from the body at rest, half within (\d+) cm",
        capfd.readouterr().err,
    )
    assert found and int(found[1]) > 5 > int(found[2]) - 5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--body", "leg"), "name a mesh and --out RIGGED.glb, or --body-mesh"),
        (("{sock}", "--body", "leg"), "name a mesh and --out"),
        (("{sock}", "--body", "leg", "-o", "{folder}/x.obj"), "is written as .glb only"),
        (("{sock}", "--body", "leg", "-o", "{folder}/x.glb", "--body-mesh", "{sock}"), "is the mesh that is read"),
        (("{sock}", "--body", "leg", "-o", "{folder}/x.glb", "--identity", "-1"), "counted from 0"),
        (("{sock}", "--body", "lge", "-o", "{folder}/x.glb"), "no recipe 'lge'"),
        (("{folder}/none.obj", "--body", "leg", "-o", "{folder}/x.glb"), "none.obj"),
        (("{far}", "--body", "leg", "-o", "{folder}/x.glb"), "does not lie around the body at rest: it spans x 9"),
        (("{sock}", "--body", "{folder}/none.glb", "-o", "{folder}/x.glb"), "no .gltf or .glb|no .glb or .gltf"),
    ],
)
def test_refusals(words: tuple[str, ...], message: str, sock: Path, tmp_path: Path) -> None:
    mesh = load_mesh(sock)
    save_mesh(Mesh(mesh.vertices + 10, mesh.faces), tmp_path / "far.obj")
    given = [word.format(sock=sock, folder=tmp_path, far=tmp_path / "far.obj") for word in words]
    with pytest.raises(DsffnetError, match=message):
        run(*given)
    assert not (tmp_path / "x.glb").exists()
