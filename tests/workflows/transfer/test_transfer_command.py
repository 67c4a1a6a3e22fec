"""``dsffnet transfer`` as a person types it: what is written and said, and that a failure leaves nothing behind."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from datagen.common.errors import CheckpointError, DsffnetError, MeshError, OutOfMemory, RecipeError, StorageError
from datagen.generate import generate
from datagen.mesh import sequences as mesh_sequences
from datagen.mesh.files import MeshFile, load_mesh, read_mesh_file, save_mesh
from datagen.mesh.geometry import Mesh
from datagen.store import open_dataset
from tests.support.commands import command, fails, process
from tests.support.recipes import PARTS, tiny_dataset, tiny_training
from tests.support.reports.pages import Elements
from training.engine.trainer import train
from training.inference.orientation import Axes
from training.inference.transfer import PoseTransfer
from training.viz import viewer
from training.viz.look import Look
from workflows.cli import main as cli
from workflows.transfer import run as transfer_run
from workflows.transfer.job import TransferJob
from workflows.transfer.run import TransferWork

Transfer = Callable[..., None]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny run, and in its folder meshes: pose.obj, person.obj, and a walk of 12 frames."""
    folder = tmp_path_factory.mktemp("transfer")
    generate(tiny_dataset(), str(folder / "leg.zarr"))
    train(tiny_training(), data=str(folder / "leg.zarr"), run=folder / "run")
    dataset = open_dataset(str(folder / "leg.zarr"))
    save_mesh(Mesh(dataset.vertices(3, 7), dataset.faces(3)), folder / "pose.obj")
    save_mesh(Mesh(dataset.vertices(4, 0), dataset.faces(4)), folder / "person.obj")
    for frame in range(12):
        vertices = dataset.vertices(3, frame % 10) + np.float32(0.1 * frame)
        save_mesh(Mesh(vertices, dataset.faces(3)), folder / "walk" / f"frame_{frame}.ply")
    (folder / "taken.png").mkdir()
    return folder / "run"


@pytest.fixture
def transfer(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Transfer:
    """Run the command in this process, from the folder of the meshes; files go to tmp_path where they are ``out``."""
    monkeypatch.chdir(run.parent)

    def call(*words: object) -> None:
        options = cli.parsed(["transfer", *map(str, words), "--model", str(run)])
        options.command(options)

    return call


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_pair_with_picture_and_page(
    transfer: Transfer, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    transfer("pose.obj", "person.obj", "-o", tmp_path / "posed.obj", "--picture", "--viewer")
    assert capsys.readouterr().out.endswith(f"; beside it {tmp_path}/posed.png, {tmp_path}/posed.html\n")
    assert files(tmp_path) == ["posed.html", "posed.obj", "posed.png"]
    source, target = load_mesh("pose.obj"), load_mesh("person.obj")
    expected = PoseTransfer.from_run(run)(source=source, target=target)
    posed = load_mesh(tmp_path / "posed.obj")
    assert np.allclose(posed.vertices, expected.vertices, atol=1e-5) and np.array_equal(posed.faces, target.faces)


def test_a_vertex_in_no_face_is_told_of_and_kept(
    transfer: Transfer,
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    transfer("pose.obj", "person.obj", "-o", tmp_path / "plain.obj")
    loose = tmp_path / "loose.obj"
    lines = [*(run.parent / "person.obj").read_text().splitlines(), "v 9 9 9"]
    loose.write_text("\n".join(f"{line} 1 0 0" if line.startswith("v ") else line for line in lines) + "\n")
    drawn = list[NDArray[np.floating] | None]()

    def shown(mesh: Mesh, axes: object, path: Path, look: Look | None) -> object:
        drawn.append(None if look is None else look.colors)
        return real(mesh, axes, path, look)

    real = transfer_run._upright
    monkeypatch.setattr(transfer_run, "_upright", shown)
    transfer("pose.obj", loose, "-o", tmp_path / "posed.obj", "--picture")
    assert any(colours is not None and len(colours) == 32 for colours in drawn), "vertex colours are drawn all the same"
    assert "loose.obj is 1 vertex in no face (number 32, counted from 0)" in capsys.readouterr().err
    plain, posed = (load_mesh(tmp_path / name).vertices for name in ("plain.obj", "posed.obj"))
    assert len(posed) == 33 and np.allclose(posed[:-1], plain, atol=1e-6) and posed[-1].min() > 5


def test_files_of_any_name_are_taken_drawn_and_said(
    transfer: Transfer, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Bytes that are no UTF-8, mathematics, markup and a terminal's commands, in one name each."""
    source = tmp_path / os.fsdecode(b"pose \xff $x^ <script> \x1b[31m.obj")
    target = tmp_path / "$\\frac{$ =cmd \u202e.obj"
    for name, place in (("pose.obj", source), ("person.obj", target)):
        shutil.copy(run.parent / name, place)
    out = tmp_path / os.fsdecode(b"posed \xfe\n.obj")
    transfer(source, target, "-o", out, "--picture", "--viewer")
    assert all(out.with_suffix(suffix).stat().st_size > 500 for suffix in (".obj", ".png", ".html"))
    out_text, err_text = capsys.readouterr()
    said = out_text + err_text
    assert "\x1b" not in said and "\u202e" not in said and len(out_text.splitlines()) == 1
    assert r"posed \udcfe\n.obj" in out_text and r"\x1b[31m" in out_text


def test_both_ways_of_naming_the_meshes_are_one(transfer: Transfer, tmp_path: Path) -> None:
    transfer("pose.obj", "person.obj", "-o", tmp_path / "a.ply")
    transfer("--target", "person.obj", "--source", "pose.obj", "--out", tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_refining_is_off_unless_asked(transfer: Transfer, tmp_path: Path) -> None:
    transfer("pose.obj", "person.obj", "-o", tmp_path / "a.obj")
    transfer("pose.obj", "person.obj", "-o", tmp_path / "b.obj", "--refine")
    plain, refined = (load_mesh(tmp_path / name).vertices for name in ("a.obj", "b.obj"))
    assert abs(plain - refined).max() > 1e-4


def test_a_torn_target_is_told_of_once(
    transfer: Transfer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a sequence with its first such frame, by its number."""

    def tearing(self: PoseTransfer, sources: Iterator[Mesh], target: Mesh, **_: object) -> Iterator[Mesh]:
        for number, _source in enumerate(sources):
            yield Mesh(target.vertices * (10 if number >= 3 else 1), target.faces)

    monkeypatch.setattr(PoseTransfer, "sequence", tearing)
    transfer("pose.obj", "person.obj", "-o", tmp_path / "a.obj")
    assert "comes out torn" not in capsys.readouterr().err
    transfer("walk", "person.obj", "-o", tmp_path / "torn")
    said = capsys.readouterr().err
    assert said.count("comes out torn") == 1 and "frame 4: person.obj comes out torn" in said


def test_what_was_tried_is_not_posed_again_unless_it_is_to_be_refined(run: Path) -> None:
    source, target = (read_mesh_file(run.parent / name) for name in ("pose.obj", "person.obj"))
    job = TransferJob([source.path], target.path, Path("out.obj"), is_sequence=False)
    for refine in (False, True):
        given = replace(job, refine=refine), PoseTransfer.from_run(run)
        work = TransferWork(*given, first=source.mesh, target=target, known=target.mesh)
        assert (next(work.posed()) is target.mesh) != refine


def test_projection_onto_parts_is_an_option(
    transfer: Transfer, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    parts = tmp_path / "parts"
    train(tiny_training(**PARTS, steps=1, edge_weight=0), data=str(run.parent / "leg.zarr"), run=parts)
    transfer("pose.obj", "person.obj", "-o", tmp_path / "a.obj")
    transfer("pose.obj", "person.obj", "-o", tmp_path / "b.obj", "--project", parts)
    plain, projected = (load_mesh(tmp_path / name) for name in ("a.obj", "b.obj"))
    expected = PoseTransfer.from_run(run, project=parts)(source=load_mesh("pose.obj"), target=load_mesh("person.obj"))
    assert np.allclose(projected.vertices, expected.vertices, atol=1e-5)
    assert abs(plain.vertices - projected.vertices).max() > 1e-4
    for error, is_told in ((0.0, False), (float("nan"), True)):
        capsys.readouterr()
        monkeypatch.setattr(PoseTransfer, "rest_error", lambda self, mesh, error=error: error)
        transfer("pose.obj", "person.obj", "-o", tmp_path / "d.obj", "--project", parts)
        assert (f"person.obj is no body that {parts}" in capsys.readouterr().err) == is_told
    with pytest.raises(
        CheckpointError, match=r"--project humann: there is no such run .* along: animals, dressed, dsff"
    ):
        transfer("pose.obj", "person.obj", "-o", tmp_path / "c.obj", "--project", "humann")
    options = cli.parsed(["transfer", "pose.obj", "person.obj", "-o", "c.obj", "--project", "human"])
    with pytest.raises(RecipeError, match="--project is for outputs of a network that is named: add --model"):
        options.command(options)


def test_axes_by_hand_give_the_same_body_lying_as_its_file(transfer: Transfer, run: Path, tmp_path: Path) -> None:
    axes = Axes("Z", "-Y")
    target = load_mesh("person.obj")
    save_mesh(Mesh(axes.restored(target.vertices), target.faces), tmp_path / "lying.obj")
    transfer("pose.obj", "person.obj", "-o", tmp_path / "a.obj")
    transfer("pose.obj", tmp_path / "lying.obj", "-o", tmp_path / "b.obj", "--up", "Y,Z", "--front", "Z,-Y")
    standing, lying = (load_mesh(tmp_path / name).vertices for name in ("a.obj", "b.obj"))
    assert np.allclose(axes.turned(lying), standing, atol=1e-5)


@pytest.mark.parametrize("words", [("--front", "-Y"), ("--front=-Y",), ("--front", "-Y,-Y"), ("--front", "-y")])
def test_an_axis_with_a_minus_is_no_option(words: tuple[str, ...]) -> None:
    found = cli.parsed(["transfer", "--model=r", "--out=o", *words, "--up", "-Z"])
    assert found.front.upper() in ("-Y", "-Y,-Y") and found.up == "-Z"


def test_several_geometries_are_one_body_or_chosen(
    transfer: Transfer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    person = load_mesh("person.obj")
    bodies = {name: trimesh.Trimesh(person.vertices, person.faces, process=False) for name in ("body", "coat", "shoe")}
    trimesh.Scene(bodies).export(tmp_path / "three.glb")
    transfer("pose.obj", tmp_path / "three.glb", "-o", tmp_path / "whole.glb")
    assert f"{tmp_path}/three.glb: 'body', 'coat', 'shoe' as one body (--target-geom" in capsys.readouterr().out
    assert read_mesh_file(tmp_path / "whole.glb").geometries == ("body", "coat", "shoe")
    chosen = ("--source-geometry", "coat", "--target-geometry", "body", "--target-geometry", "shoe")
    transfer(tmp_path / "three.glb", tmp_path / "three.glb", "-o", tmp_path / "some.glb", *chosen)
    assert read_mesh_file(tmp_path / "some.glb").geometries == ("body", "shoe")
    with pytest.raises(MeshError, match=r"person.obj has no object or group 'hat'; it has none"):
        transfer("pose.obj", "person.obj", "-o", tmp_path / "z.obj", "--target-geometry", "hat")
    with pytest.raises(MeshError, match="is one mesh as a whole"):
        transfer(*(2 * ["walk/frame_0.ply"]), "-o", tmp_path / "z.obj", "--target-geometry", "hat")


@pytest.mark.parametrize("out", ["skins/person.glb", "out/person.obj"])
def test_a_picture_is_not_written_over_a_texture(transfer: Transfer, tmp_path: Path, out: str) -> None:
    """In the target's own folder it is the person's file; in another, the copy that the output needs."""
    (tmp_path / "skins").mkdir()
    (tmp_path / "skins" / "person.mtl").write_text("newmtl skin\nmap_Kd person.png\n")
    (tmp_path / "skins" / "person.png").write_bytes(b"a texture")
    (tmp_path / "skins" / "person.obj").write_text("mtllib person.mtl\n" + Path("person.obj").read_text())
    with pytest.raises(MeshError, match=r"write over the texture .*person\.png"):
        transfer("pose.obj", tmp_path / "skins" / "person.obj", "-o", tmp_path / out, "--picture")
    assert (tmp_path / "skins" / "person.png").read_bytes() == b"a texture"
    transfer("pose.obj", tmp_path / "skins" / "person.obj", "-o", tmp_path / "out" / "posed.obj", "--picture")
    assert (tmp_path / "out" / "person.png").read_bytes() == b"a texture"


def test_a_folder_becomes_a_folder_named_after_the_frames_and_one_animation(
    transfer: Transfer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    transfer("walk", "person.obj", "-o", tmp_path / "out" / "walked", "--smooth", "5", "--picture", "--viewer")
    frames = sorted(f"frame_{number}.obj" for number in range(12))
    assert files(tmp_path / "out" / "walked") == ["animation.glb", *frames]
    assert files(tmp_path / "out") == [
        "walked",
        "walked.html",
        "walked.png",
        *(f"walked/{n}" for n in ["animation.glb", *frames]),
    ]
    said = capsys.readouterr()
    assert "12 frames of person.obj" in said.out and "transfer" in said.err and "12/12" in said.err


def test_frames_take_the_place_of_earlier_ones_but_not_of_other_files(
    transfer: Transfer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    skins, out = tmp_path / "skins", tmp_path / "out"
    (skins / "textures").mkdir(parents=True)
    (skins / "person.mtl").write_text("newmtl skin\nmap_Kd textures/skin.png\n")
    (skins / "textures" / "skin.png").write_bytes(b"a texture")
    (skins / "person.obj").write_text("mtllib person.mtl\n" + Path("person.obj").read_text())
    out.mkdir()
    (out / "person.mtl").write_text("of another body")
    for _ in range(2):
        (out / "frame_1.obj").write_text("of an earlier run")
        transfer("walk", skins / "person.obj", "-o", out)
        assert (out / "person.mtl").read_text() == "of another body"
        assert "person.mtl: another file of that name" in capsys.readouterr().err
        assert load_mesh(out / "frame_1.obj") and (out / "textures" / "skin.png").read_bytes() == b"a texture"


def test_materials_that_are_written_beside_are_named(
    transfer: Transfer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "skin").mkdir()
    (tmp_path / "skin" / "person.mtl").write_text("newmtl skin\n")
    (tmp_path / "skin" / "person.obj").write_text("mtllib person.mtl\n" + Path("person.obj").read_text())
    transfer("pose.obj", tmp_path / "skin" / "person.obj", "-o", tmp_path / "posed.obj")
    assert files(tmp_path) == ["person.mtl", "posed.obj", "skin", "skin/person.mtl", "skin/person.obj"]
    assert capsys.readouterr().out.endswith(f"; beside it {tmp_path}/person.mtl\n")


def test_a_pattern_becomes_one_animated_file(transfer: Transfer, tmp_path: Path) -> None:
    transfer("walk/frame_*.ply", "person.obj", "-o", tmp_path / "walked.glb")
    assert files(tmp_path) == ["walked.glb"]


def test_an_animation_of_a_glb_is_posed_as_its_frames_in_files(
    transfer: Transfer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [read_mesh_file(f"walk/frame_{number}.ply") for number in range(12)]
    walk = tmp_path / "walk.glb"
    mesh_sequences.write_animation(frames[0], [each.mesh.vertices for each in frames], walk, frames_per_second=30)
    transfer(walk, "person.obj", "-o", tmp_path / "one.obj")
    assert "walk.glb is taken at rest; --animation NAME poses every frame of 'poses'" in capsys.readouterr().out
    transfer(walk, "person.obj", "--animation", "poses", "-o", tmp_path / "frames", "--smooth", "5")
    transfer("walk", "person.obj", "-o", tmp_path / "expected", "--smooth", "5")
    for number in range(12):
        found = load_mesh(tmp_path / "frames" / f"walk-{number:04d}.obj").vertices
        assert np.allclose(found, load_mesh(tmp_path / "expected" / f"frame_{number}.obj").vertices, atol=2e-4)
    transfer(walk, "person.obj", "--animation", "poses", "--fps", 15, "-o", tmp_path / "a.glb", "--picture", "--viewer")
    assert "a.glb: 6 frames" in capsys.readouterr().out
    assert "walk.glb: poses (6 frames)" in (tmp_path / "a.html").read_text()


@pytest.mark.parametrize(("limit", "shown"), [(None, range(12)), (25_000, range(0, 12, 4))])
def test_the_page_of_a_sequence_plays_its_frames_or_says_how_many(
    transfer: Transfer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    limit: int | None,
    shown: range,
) -> None:
    if limit:
        monkeypatch.setattr(viewer, "MOTION_LIMIT", limit)
    transfer("walk", "person.obj", "-o", tmp_path / "walked.glb", "--viewer", "--fps", "24")
    data = json.loads(Elements((tmp_path / "walked.html").read_text()).texts["data"])
    (example,) = data["examples"]
    assert [frame["name"] for frame in example["motion"]["source"]] == [f"frame_{number}.ply" for number in shown]
    assert len(example["motion"]["output"]) == len(shown) and example["motion"]["rate"] == 24 * len(shown) / 12
    assert example["title"] == "person.obj in the poses of walk (12 frames)"
    assert ("plays one of 4 frames: all 12" in capsys.readouterr().err) == bool(limit)


def test_frames_come_in_their_numbers_order(transfer: Transfer, run: Path, tmp_path: Path) -> None:
    """Frame 10 comes after frame 9: the walk goes on, so that the output of frame 10 is the farthest but one."""
    transfer("walk", "person.obj", "-o", tmp_path / "walked")
    sources = [load_mesh(f"walk/frame_{number}.ply") for number in range(12)]
    expected = list(PoseTransfer.from_run(run).sequence(sources, load_mesh("person.obj")))
    found = load_mesh(tmp_path / "walked" / "frame_10.obj")
    assert np.allclose(found.vertices, expected[10].vertices, atol=1e-5)


def broken_walk(folder: Path, *, broken: int) -> Path:
    for number in range(3):
        save_mesh(load_mesh("pose.obj"), folder / f"{number}.obj")
    (folder / f"{broken}.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return folder


def test_of_a_broken_frame_on_what_is_finished_stays_beside_the_output(
    transfer: Transfer, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    walk = broken_walk(tmp_path / "walk", broken=1)
    monkeypatch.setattr(TransferWork, "_settle_axes", lambda work, weights: None)  # it looks at later frames, too
    before = files(tmp_path)
    with pytest.raises(MeshError, match=r"1\.obj"):
        transfer(walk, "person.obj", "-o", tmp_path / "walked.glb")
    assert files(tmp_path) == before, "an animation appears whole or not at all"
    for unfinished in ("walked.unfinished", "walked.unfinished-2"):
        with pytest.raises(MeshError, match=r"1\.obj"):
            transfer(walk, "person.obj", "-o", tmp_path / "walked")
        assert f"1 frame is finished, in {tmp_path / unfinished}" in capsys.readouterr().err
        assert load_mesh(tmp_path / unfinished / "0.obj")
        before = sorted([*before, unfinished, f"{unfinished}/0.obj"])
        assert files(tmp_path) == before


def test_an_interruption_keeps_what_is_finished_and_breaks_nothing(
    transfer: Transfer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frames of an earlier run stay whole, and none of the new ones is among them."""
    transfer("walk", "person.obj", "-o", tmp_path / "walked")
    before = {path.name: path.read_bytes() for path in (tmp_path / "walked").iterdir()}
    read = TransferJob.read_source

    def until_ctrl_c(job: TransferJob, number: int) -> MeshFile:
        if number == 7:
            raise KeyboardInterrupt
        return read(job, number)

    monkeypatch.setattr(TransferJob, "read_source", until_ctrl_c)
    with pytest.raises(KeyboardInterrupt, match=r"7 frames are finished, in .*walked\.unfinished; the same comm"):
        transfer("walk", "person.obj", "-o", tmp_path / "walked", "--refine")
    assert {path.name: path.read_bytes() for path in (tmp_path / "walked").iterdir()} == before
    assert files(tmp_path / "walked.unfinished") == [f"frame_{number}.obj" for number in range(7)]
    assert all(load_mesh(path).faces.size for path in (tmp_path / "walked.unfinished").iterdir())


def test_a_first_frame_that_is_broken_leaves_nothing_behind(transfer: Transfer, tmp_path: Path) -> None:
    walk = broken_walk(tmp_path / "walk", broken=0)
    before = files(tmp_path)
    with pytest.raises(MeshError, match=r"0\.obj"):
        transfer(walk, "person.obj", "-o", tmp_path / "walked")
    assert files(tmp_path) == before


BALL = trimesh.creation.icosphere(1)
ROUND, TRIANGLES = np.asarray(BALL.vertices) * (0.3, 1.0, 0.2), np.asarray(BALL.faces)
COUNT = len(ROUND)
ODD: dict[str, tuple[NDArray[np.floating], NDArray[np.integer]]] = {
    "faces of two corners": (ROUND, np.concatenate([TRIANGLES, [[0, 0, 1], [2, 2, 2]]])),
    "every face twice": (ROUND, np.concatenate([TRIANGLES, TRIANGLES])),
    "every vertex twice": (np.concatenate([ROUND, ROUND]), np.concatenate([TRIANGLES, TRIANGLES + COUNT])),
    "vertices of no face": (np.concatenate([ROUND, 1.1 * ROUND, 1.2 * ROUND]), TRIANGLES),
    "faces without area": (np.concatenate([ROUND, ROUND[[0, 0, 0]]]), np.concatenate([TRIANGLES, [[42, 43, 44]]])),
    "no face with an area": (ROUND, np.array([[0, 1, 0], [1, 1, 2]])),
    "inside out": (ROUND, TRIANGLES[:, ::-1]),
    "four faces at an edge": (ROUND, np.concatenate([TRIANGLES, [[0, 1, 20], [0, 1, 30]]])),
    "far away": (ROUND + 1e7, TRIANGLES),
    "in nanometres": (ROUND * 1e9, TRIANGLES),
    "in light years": (ROUND * 1e-14, TRIANGLES),
}
UNUSABLE: dict[str, tuple[NDArray[np.floating], NDArray[np.integer], str]] = {
    "not a number": (np.where(np.arange(COUNT)[:, None] == 5, np.nan, ROUND), TRIANGLES, "the first is number 5"),
    "infinite": (np.where(np.arange(COUNT)[:, None] == 5, np.inf, ROUND), TRIANGLES, "the first is number 5"),
    "one face, and points": (ROUND, TRIANGLES[:1], "all vertices lie in one slanted plane"),
    "a face beyond the last vertex": (ROUND, np.array([[0, 1, 99]]), "vertex 100, but there are 42"),
    "too large to be squared": (ROUND * 1e200, TRIANGLES, r"coordinates up to 1e\+200: scale it"),
    "too small to be squared": (ROUND * 1e-200, TRIANGLES, "long at most: scale it"),
    "so far away that it has no form": (ROUND + 1e17, TRIANGLES, "scale it"),
    "one place": (ROUND * 0 + 1, TRIANGLES, "no extent"),
}


def written_obj(path: Path, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> Path:
    lines = ["v {!r} {!r} {!r}".format(*map(float, row)) for row in vertices]
    lines += ["f {} {} {}".format(*row) for row in (faces + 1).tolist()]
    path.write_text("\n".join([*lines, ""]))
    return path


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("what", sorted(ODD))
def test_odd_meshes_are_posed_without_a_number_that_is_none(transfer: Transfer, tmp_path: Path, what: str) -> None:
    odd = written_obj(tmp_path / "odd.obj", *ODD[what])
    transfer(odd, "person.obj", "-o", tmp_path / "as_source.obj", "--align")
    transfer("pose.obj", odd, "-o", tmp_path / "as_target.obj", "--refine")
    assert len(load_mesh(tmp_path / "as_source.obj").vertices) == len(load_mesh("person.obj").vertices)
    assert len(load_mesh(tmp_path / "as_target.obj").vertices) == len(ODD[what][0])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("what", sorted(UNUSABLE))
@pytest.mark.parametrize("role", ["source", "target"])
def test_unusable_meshes_are_one_line_before_any_work(
    transfer: Transfer, tmp_path: Path, what: str, role: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PoseTransfer, "from_run", None)
    *mesh, says = UNUSABLE[what]
    bad = written_obj(tmp_path / "bad.obj", *mesh)
    with pytest.raises(MeshError, match=says) as caught:
        transfer(*((bad, "person.obj") if role == "source" else ("pose.obj", bad)), "-o", tmp_path / "x.obj")
    assert "\n" not in str(caught.value) and str(bad) in str(caught.value) and files(tmp_path) == ["bad.obj"]


def test_a_source_may_be_points_and_a_target_needs_faces(transfer: Transfer, tmp_path: Path) -> None:
    points = written_obj(tmp_path / "scan.obj", ROUND, TRIANGLES[:0])
    cloud = tmp_path / "scan.ply"
    trimesh.PointCloud(ROUND).export(cloud)
    transfer(written_obj(tmp_path / "ball.obj", ROUND, TRIANGLES), "person.obj", "-o", tmp_path / "posed.obj")
    expected = load_mesh(tmp_path / "posed.obj").vertices  # this network sees vertices alone
    for number, scan in enumerate((points, cloud)):
        transfer(scan, "person.obj", "-o", tmp_path / f"{number}.obj", "--picture", "--viewer")
        np.testing.assert_allclose(load_mesh(tmp_path / f"{number}.obj").vertices, expected, atol=1e-5)
        assert (tmp_path / f"{number}.png").stat().st_size and (tmp_path / f"{number}.html").stat().st_size
        with pytest.raises(
            MeshError, match=r"42 vertices and no faces .*; triangles are needed; only the source .* may be po"
        ):
            transfer("pose.obj", scan, "-o", tmp_path / "x.obj")


def test_memory_that_runs_out_is_one_line_about_the_meshes(
    transfer: Transfer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def vertices(*_: object) -> None:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 99 bytes")

    monkeypatch.setattr(PoseTransfer, "vertices", vertices)
    with pytest.raises(OutOfMemory, match=r"memory ran out .*decimate"):
        transfer("pose.obj", "person.obj", "-o", tmp_path / "x.obj")
    assert not files(tmp_path)


def test_more_frames_than_an_animation_holds_are_said_before_any_is_made(
    transfer: Transfer, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_sequences, "FRAME_LIMIT", 11)
    with monkeypatch.context() as patched, pytest.raises(MeshError, match="12 frames are more than 11"):
        patched.setattr(PoseTransfer, "sequence", None)
        transfer("walk", "person.obj", "-o", tmp_path / "walked.glb")
    transfer("walk", "person.obj", "-o", tmp_path / "walked")
    assert "no animation.glb: 12 frames are more than 11" in capsys.readouterr().err
    assert files(tmp_path / "walked") == sorted(f"frame_{number}.obj" for number in range(12))


@pytest.mark.parametrize(
    ("words", "error", "says"),
    [
        (("pose.obj", "person.obj", "-o", "person.obj"), MeshError, "never written over"),
        (("pose.obj", "person.obj", "-o", "./pose.obj"), MeshError, "never written over"),
        (("walk/*.ply", "walk/frame_3.ply", "-o", "walk"), MeshError, "never written over"),
        (("pose.obj", "-o", "x.obj"), RecipeError, "name two meshes"),
        (("pose.obj", "person.obj", "--source", "pose.obj", "-o", "x.obj"), RecipeError, "name two meshes"),
        (("pose.obj", "person.obj", "-o", "x.xyz"), MeshError, "x.xyz"),
        (("none.obj", "person.obj", "-o", "x.obj"), MeshError, "none.obj"),
        (("pose.obj", "person.obj", "-o", "pose.obj/x.obj"), StorageError, "pose.obj"),
        (("pose.obj", "person.obj", "-o", "x.obj", "--up", "W"), RecipeError, "'W' is no axis"),
        (("pose.obj", "person.obj", "-o", "x.obj", "--align", "--up", "Z"), RecipeError, "--align finds"),
        (("walk", "person.obj", "-o", "x.glb", "--smooth", "much"), RecipeError, "'much'"),
        (("walk", "person.obj", "-o", "x.glb", "--smooth", "0.1s"), RecipeError, "takes 3 frames.* 0.13s or more"),
        (("walk", "person.obj", "-o", "x.mp4"), MeshError, "not into one .mp4; choose --out x.glb or --out x"),
        (("pose.obj", "person.obj", "-o", "x.obj", "--smooth", "7"), RecipeError, "pose.obj is one mesh"),
        (("walk", "person.obj", "-o", "x.glb", "--animation", "a"), RecipeError, "walk is frames: leave it out"),
        (("pose.obj", "person.obj", "-o", "x.glb", "--animation", "a"), MeshError, "pose.obj has no animation 'a'"),
        (("pose.obj", "person.obj", "-o", "taken.obj", "--picture"), MeshError, "taken.png is a folder"),
    ],
)
def test_what_cannot_be_done_is_said_before_the_weights_are_read(
    transfer: Transfer,
    words: tuple[str, ...],
    error: type[DsffnetError],
    says: str,
    run: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(PoseTransfer, "from_run", None)
    before = files(run.parent)
    with pytest.raises(error, match=says):
        transfer(*words)
    assert files(run.parent) == before


def test_models_and_servers_that_are_not_there(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(run.parent)

    def call(model: str) -> None:
        options = cli.parsed(["transfer", "pose.obj", "person.obj", "-o", str(tmp_path / "x.obj"), "--model", model])
        options.command(options)

    along = "Name one; these come along: animals, dressed, dsffnet-people, human"
    with pytest.raises(CheckpointError, match=f"--model nowhere: there is no such run or weights. {along}"):
        call("nowhere")
    with pytest.raises(RecipeError, match="--tracking-uri"):
        call("models:/dsffnet@latest-trained")
    assert not files(tmp_path)


def test_one_line_and_an_exit_status(run: Path, tmp_path: Path) -> None:
    words = ("--model", run, run.parent / "none.obj", run.parent / "person.obj", "-o", tmp_path / "x.obj")
    fails(command("transfer", *words), 1, "none.obj")


def test_a_transfer_needs_neither_ray_nor_mlflow_nor_pandas(run: Path, tmp_path: Path) -> None:
    banned = ", ".join(f"'{name}': None" for name in ("ray", "mlflow", "pandas", "anny", "smplx"))
    (tmp_path / "sitecustomize.py").write_text(f"import sys\nsys.modules.update({{{banned}}})\n")
    words = ("--model", run, run.parent / "pose.obj", run.parent / "person.obj", "-o", tmp_path / "x.obj")
    done = process("transfer", *words, PYTHONPATH=f"{tmp_path}:{Path(cli.__file__).parents[1]}")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "x.obj").is_file()


def test_one_file_may_be_source_and_target(transfer: Transfer, tmp_path: Path) -> None:
    transfer("pose.obj", "pose.obj", "-o", tmp_path / "x.obj")
    assert files(tmp_path) == ["x.obj"]
