"""Sessions: the newest counts, two know nothing of each other, and nothing stays when one ends."""

import gc
import io
import threading
import weakref
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from datagen.bodies import load_body
from datagen.characters.motion import Motion
from datagen.common.errors import MeshError
from datagen.mesh.files import load_mesh, read_mesh_file, save_mesh
from datagen.mesh.geometry import Mesh
from datagen.mesh.sequences import write_animation
from datagen.poses import draw_poses
from datagen.recipe import LegBody, PoseRecipe, RangePoses
from tests.support.shapes.rigged_files import nodding
from training.inference.domain_check import remarks
from training.inference.orientation import Axes
from training.inference.standing import Standing
from workflows.cli import main as cli
from workflows.demo.bodies import Figure
from workflows.demo.captions import about, label, legend, plain
from workflows.demo.page import place_of
from workflows.demo.poses import PERSON, Pose
from workflows.demo.session import Newest, Session
from workflows.demo.transfers import Asked, Outcome, Switches, Transfers, clash_of, require_room
from workflows.pretrained import own_weights

STANDING = Switches(up="Y", front="Z")


class Seen:
    """What a page would show."""

    def __init__(self) -> None:
        self.frames, self.failures, self.done = list[Outcome](), list[str](), threading.Semaphore(0)

    def posing(self) -> None:
        pass

    def show(self, outcome: Outcome) -> None:
        self.frames.append(outcome)
        if len(outcome.frames) == outcome.count:
            self.done.release()

    def fail(self, message: str) -> None:
        self.failures.append(message)
        self.done.release()

    def wait(self) -> None:
        assert self.done.acquire(timeout=120)


@pytest.fixture(scope="module")
def transfers() -> Transfers:
    return Transfers(own_weights("human"))


@pytest.fixture
def view() -> Seen:
    return Seen()


@pytest.fixture
def session(tmp_path: Path, transfers: Transfers, view: Seen) -> Iterator[Session]:
    made = Session(tmp_path / "session", transfers, view)
    yield made
    made.close()


@pytest.fixture(scope="module")
def legs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of one body in three poses."""
    body, folder = load_body(LegBody(rings=8, segments=6)), tmp_path_factory.mktemp("legs")
    parameters = body.draw_identity(np.random.default_rng(0), 0)
    poses = draw_poses(PoseRecipe(distribution=RangePoses(degrees={"left_knee": ((0, 90), (0, 0), (0, 0))})), range(3))
    vertices, faces = body.vertices(parameters, poses), body.faces(parameters)
    for number, each in enumerate(vertices):
        save_mesh(Mesh(each, faces), folder / f"leg{number}.obj")
    return sorted(folder.iterdir())


def upload(session: Session, role: str, path: Path) -> tuple[Path, ...]:
    return session.keep(role, path.name, path.read_bytes())


class TestNewest:
    def test_of_what_waits_only_the_newest_is_done(self) -> None:
        done, began, go = list[int](), threading.Event(), threading.Event()

        def work(asked: int, stale: Callable[[], bool]) -> None:
            began.set()
            go.wait(10)
            done.append(asked)

        newest = Newest(work)
        newest.ask(0)
        began.wait(10)
        for asked in range(1, 100):  # as a slider that is dragged
            newest.ask(asked)
        go.set()
        while done[-1:] != [99]:
            assert len(done) < 3
        newest.close()
        assert done == [0, 99]

    def test_long_work_is_told_that_something_newer_waits(self) -> None:
        told, began = list[int](), threading.Event()

        def work(asked: int, stale: Callable[[], bool]) -> None:
            began.set()
            while asked == 0 and not stale():
                pass
            told.append(asked)

        newest = Newest(work)
        newest.ask(0)
        began.wait(10)
        newest.ask(1)
        while told != [0, 1]:
            pass
        newest.close()


def test_the_result_is_that_of_the_command_line(
    session: Session, view: Seen, legs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, target = upload(session, "source", legs[1]), upload(session, "target", legs[0])
    session.ask(Asked(source, target, Switches(up="Y", front="Z", refine=True)))
    view.wait()
    assert not view.failures
    name, content, _ = session.result(".obj")
    out = tmp_path / "posed.obj"
    options = ["--model", "human", "--up", "Y", "--front", "Z", "--refine"]
    cli.main(["transfer", str(legs[1]), str(legs[0]), "-o", str(out), *options])
    assert content == out.read_bytes()
    assert name == "leg0-posed.obj"
    assert not np.allclose(load_mesh(out).vertices, load_mesh(legs[0]).vertices, atol=1e-3)


def test_frames_come_one_after_the_other_and_go_into_one_animation(
    session: Session, view: Seen, legs: list[Path]
) -> None:
    target = upload(session, "target", legs[0])
    session.ask(Asked(tuple(legs), target, STANDING, moving=True))
    view.wait()
    assert [outcome.count for outcome in view.frames] == [3, 3, 3]
    name, content, _ = session.result(".glb")
    assert name == "leg0-posed.glb" and b'"animations"' in content


@pytest.mark.parametrize("kind", ["joints", "morph targets"])
def test_an_animation_of_a_source_is_played_as_the_command_poses_it(
    kind: str, session: Session, view: Seen, legs: list[Path], tmp_path: Path
) -> None:
    walk = tmp_path / "walk.glb"
    if kind == "joints":
        nodding(walk)
    else:
        leg = read_mesh_file(legs[0])
        write_animation(leg, [load_mesh(path).vertices for path in legs], walk, frames_per_second=15)
    animation, frames = ("Nod", 16) if kind == "joints" else ("poses", 3)
    source, target = upload(session, "source", walk), upload(session, "target", legs[0])
    session.ask(Asked(source, target, replace(STANDING, force=True, animation=animation), moving=True))
    view.wait()
    assert not view.failures and [outcome.count for outcome in view.frames] == [frames] * frames
    shown = view.frames[-1].frames
    assert np.ptp([frame.source.vertices for frame in shown], axis=0).max() > 0.05
    out = tmp_path / "posed.glb"
    options = ["--model", "human", "--up", "Y", "--front", "Z", "--animation", animation, "--fps", "15"]
    cli.main(["transfer", str(walk), str(legs[0]), "-o", str(out), *options])
    posed = Motion.of(read_mesh_file(out), "poses", frames_per_second=15)
    assert posed.count == frames
    for number, frame in enumerate(shown):
        assert np.allclose(posed.mesh(number).vertices, frame.posed.vertices, atol=1e-4)
    session.ask(Asked(source, target, replace(STANDING, force=True)))
    view.wait()
    assert view.frames[-1].count == 1


def test_an_animation_longer_than_the_page_plays_is_refused(
    session: Session, view: Seen, legs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workflows.demo.transfers.FRAME_LIMIT", 15)
    source, target = upload(session, "source", nodding(tmp_path / "walk.glb")), upload(session, "target", legs[0])
    session.ask(Asked(source, target, replace(STANDING, force=True, animation="Nod"), moving=True))
    view.wait()
    assert "16 frames, the page plays 15" in view.failures[0] and not view.frames


def test_messages_name_the_controls_of_the_page_and_no_folder_of_the_server(legs: list[Path]) -> None:
    mesh, way = load_mesh(legs[0]), Standing(np.eye(3), misfit=1.0, rest_error=30.0)
    name = str(legs[0].parent / "source-1" / "leg.obj")
    three = Mesh(
        np.concatenate([mesh.vertices + 9 * place for place in range(3)]),
        np.concatenate([mesh.faces + len(mesh.vertices) * place for place in range(3)]),
    )
    said = remarks(three, name=name, axes=way, way=None, both=None, stated=False, seen=None)
    lines = [plain(each, legs[0].parent) for each in said]
    assert lines[0].startswith("leg.obj is unlike") and lines[0].endswith("look at it")
    assert "choose its geometries" in lines[1]
    lines += [
        plain(each, legs[0].parent)
        for each in ("a is a person and b is an animal; or add --force, to see", "add --align, or --up=Z --front=-Y")
    ]
    assert lines[-2:] == ["a is a person and b is an animal; or choose Force, to see", "choose Align, or Up Z Front -Y"]
    assert not any("--" in line for line in lines)


def test_words_are_explained_where_they_are_said(session: Session, view: Seen, legs: list[Path]) -> None:
    session.ask(Asked((legs[1],), (legs[0],), STANDING))
    view.wait()
    outcome = session.outcome
    assert outcome is not None
    outcome.warnings = []
    assert "misread" not in about(outcome, session.folder)
    outcome.warnings = ["leg.obj is unlike the bodies of training (misread by 20 degrees, more than 7)"]
    assert "*misread*: the weights say how each part of a mesh is turned" in about(outcome, session.folder)
    assert not legend(outcome, outcome.frames[0], 1.0, shown=False)
    known = replace(outcome.frames[0], pmd=1e-4)
    for shown in (False, True):
        assert ("PMD: mean square of it" if shown else "PMD: mean square of the distance of each vertex") in legend(
            outcome, known, 1.0, shown=shown
        )


def test_a_broken_file_is_refused_in_one_line_and_the_last_one_stays(session: Session, legs: list[Path]) -> None:
    kept = upload(session, "source", legs[0])
    with pytest.raises(MeshError, match=r"broken\.obj") as refused:
        session.keep("source", "broken.obj", b"v 0 0 0\nf 1 2 9\n")
    assert "\n" not in str(refused.value)
    assert plain(refused.value, session.folder).startswith("broken.obj")
    assert kept[0].exists()


def test_only_the_last_uploads_are_kept(session: Session, legs: list[Path], tmp_path: Path) -> None:
    for _ in range(5):
        kept = upload(session, "source", legs[0])
    assert kept[0].exists() and len(list((tmp_path / "session").glob("source-*"))) == 2


def test_what_cannot_be_posed_is_said_and_the_next_can(session: Session, view: Seen, legs: list[Path]) -> None:
    target = upload(session, "target", legs[0])
    session.ask(Asked((legs[0],), target, STANDING, moving=True))
    view.wait()
    assert "frames to play come as a .zip" in view.failures[0]
    session.ask(Asked((legs[1],), target, STANDING))
    view.wait()
    assert view.frames and session.outcome is not None


def test_nothing_is_offered_that_is_not_of_the_meshes_that_were_refused(
    session: Session, view: Seen, legs: list[Path]
) -> None:
    target = upload(session, "target", legs[0])
    session.ask(Asked((legs[1],), target, STANDING))
    view.wait()
    assert session.result(".obj").name == "leg0-posed.obj"
    with pytest.raises(MeshError):  # what is shown stays, as what is chosen does
        session.keep("target", "broken.obj", b"v 0 0 0\nf 1 2 9\n")
    assert session.result(".obj").name == "leg0-posed.obj"
    session.ask(Asked((legs[2],), target, STANDING, moving=True))
    view.wait()
    assert view.failures and session.outcome is None
    with pytest.raises(MeshError, match="nothing is posed"):
        session.result(".obj")


def test_more_vertices_than_the_page_takes(session: Session, legs: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("workflows.demo.transfers.VERTEX_LIMIT", 10)
    with pytest.raises(MeshError, match="the page takes 10: decimate it, or use dsffnet transfer"):
        upload(session, "target", legs[0])


def test_nothing_to_download_before_anything_is_posed(session: Session) -> None:
    with pytest.raises(MeshError, match="nothing is posed: choose a source and a target"):
        session.result(".glb")


def test_two_sessions_do_not_see_each_other_and_leave_nothing(
    tmp_path: Path, transfers: Transfers, legs: list[Path]
) -> None:
    views = [Seen(), Seen()]
    two = [Session(tmp_path / str(number), transfers, view) for number, view in enumerate(views)]
    uploaded = [upload(session, "target", path) for session, path in zip(two, legs, strict=False)]
    for session, target in zip(two, uploaded, strict=True):
        session.ask(Asked((legs[2],), target, STANDING))
    for view in views:
        view.wait()
    first, second = (session.result(".obj") for session in two)
    assert (first[0], second[0]) == ("leg0-posed.obj", "leg1-posed.obj") and first[1] != second[1]
    two[0].close()
    assert not (tmp_path / "0").exists() and uploaded[1][0].exists()
    two[1].close()
    assert not list(tmp_path.iterdir())


def test_an_unexpected_failure_is_said_and_ends_nothing(tmp_path: Path, legs: list[Path]) -> None:
    class Failing:
        def run(self, *_: Any) -> None:
            raise ZeroDivisionError("one in a thousand")

    view = Seen()
    session = Session(tmp_path / "s", Failing(), view)  # type: ignore[arg-type]
    for _ in range(2):
        session.ask(Asked((legs[0],), (legs[1],)))
        view.wait()
    session.close()
    assert len(view.failures) == 2 and "one in a thousand" in view.failures[0]


@pytest.mark.parametrize("place", ["source", "target"])
def test_up_and_front_are_said_of_ones_own_mesh_alone(
    place: str, legs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, transfers: Transfers
) -> None:
    own, made_up = Mesh(load_mesh(legs[0]).vertices, load_mesh(legs[0]).faces), Figure(PERSON, (0.5,) * 6, Pose(1.0))
    monkeypatch.setattr("workflows.demo.transfers.mesh_of", lambda _: own)  # a person takes seconds to read
    lying = tmp_path / "lying.obj"
    save_mesh(Mesh(Axes("Z", "-Y").restored(own.vertices), own.faces), lying)
    bodies: dict[str, Any] = {"source": made_up, "target": made_up} | {place: (lying,)}
    frames = list[Outcome]()
    asked = Asked(**bodies, switches=Switches(up="Z", front="-Y", force=True))
    transfers.run(asked, tmp_path / "work", lambda: False, frames.append)
    for shown in (frames[0].frames[0].source, frames[0].frames[0].target):
        assert np.allclose(shown.vertices, own.vertices, atol=1e-4)


def test_up_and_front_along_one_line_wait_for_another(legs: list[Path]) -> None:
    made_up, own = Figure(PERSON, (0.5,) * 6, Pose(1.0)), (legs[0],)
    assert "cannot have Z up and face Z" in (clash_of(made_up, own, Switches(up="Z", front="Z")) or "")
    assert clash_of(made_up, own, Switches(up="Z", front="-Y")) is None
    assert clash_of(made_up, own, Switches(up="Z")) is None, "it faces -Y then"
    assert clash_of(made_up, made_up, Switches(up="Z")) is None


def test_textures_come_along_in_a_zip_and_what_is_lost_is_said(session: Session, view: Seen, legs: list[Path]) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("my body.obj", b"mtllib my body.mtl\nusemtl skin\n" + legs[0].read_bytes())
        archive.writestr("my body.mtl", b"newmtl skin\nmap_Kd textures/skin.png\nmap_Bump gone.png\n")
        archive.writestr("textures/skin.png", b"\x89PNG")
    target = session.keep("target", "body.zip", packed.getvalue())
    session.ask(Asked((legs[1],), target, STANDING))
    view.wait()
    name, content, left_out = session.result(".obj")
    assert name == "my body-posed.zip"
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert sorted(archive.namelist()) == ["my body-posed.obj", "my body.mtl", "textures/skin.png"]
    assert any("gone.png is not beside the mesh" in line for line in left_out)


def test_nothing_is_kept_after_the_end(tmp_path: Path, transfers: Transfers, view: Seen, legs: list[Path]) -> None:
    session = Session(tmp_path / "s", transfers, view)
    session.close()
    with pytest.raises(MeshError, match="this page is closed"):
        upload(session, "target", legs[0])
    assert not (tmp_path / "s").exists()


def test_of_many_transfers_one_result_is_kept(tmp_path: Path, transfers: Transfers, legs: list[Path]) -> None:
    outcomes = list[weakref.ref[Outcome]]()

    class Forgetful(Seen):
        def show(self, outcome: Outcome) -> None:
            outcomes.append(weakref.ref(outcome))
            self.done.release()

    view = Forgetful()
    session = Session(tmp_path / "s", transfers, view)
    for number in range(20):
        session.ask(Asked((legs[number % 3],), (legs[0],), STANDING))
        view.wait()
    session.close()
    gc.collect()
    alive = [outcome() for outcome in outcomes if outcome() is not None]
    assert len(outcomes) == 20 and alive == [session.outcome]


def test_frames_share_what_does_not_move(session: Session, view: Seen, legs: list[Path]) -> None:
    session.ask(Asked(tuple(legs), (legs[0],), STANDING, moving=True))
    view.wait()
    first, *others = view.frames[-1].frames
    for frame in others:
        assert frame.target is first.target and frame.source.faces is first.source.faces
        assert {mesh.vertices.dtype for mesh in (frame.source, frame.output, frame.posed)} == {np.dtype(np.float32)}


def test_geometries_apart_are_kept_and_posed_as_chosen(session: Session, view: Seen, legs: list[Path]) -> None:
    leg = load_mesh(legs[0])
    far = "".join(f"v {x} {y} {z}\n" for x, y, z in leg.vertices + 9).encode()
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in leg.faces + 1 + len(leg.vertices)).encode()
    two = b"o leg\n" + legs[0].read_bytes() + b"o other\n" + far + faces
    target = session.keep("target", "two.obj", two)
    session.ask(Asked((legs[1],), target, replace(STANDING, target_geometry=("leg",))))
    view.wait()
    assert not view.failures
    name, content, left_out = session.result(".obj")
    assert name == "two-posed.obj" and content.count(b"\nv ") + content.startswith(b"v ") == len(leg.vertices)
    assert left_out == ["other objects and groups: other"]


def test_a_scene_waits_for_a_choice_and_says_where(session: Session, tmp_path: Path) -> None:
    scene = trimesh.Scene([trimesh.creation.box().apply_translation([9 * place, 0, 0]) for place in range(2)])
    kept = session.keep("target", "two.glb", scene.export(file_type="glb"))
    with pytest.raises(MeshError) as refused:
        read_mesh_file(kept[0])
    assert plain(refused.value, session.folder).endswith("Choose among them")


def test_poses_are_read_and_no_file_of_them_stays(session: Session, tmp_path: Path) -> None:
    written = io.BytesIO()
    np.savez(written, poses=np.zeros((4, 66)))
    assert session.keep_poses("walk.npz", written.getvalue()).count == 4
    for name, content in (("walk.npz", b"none"), ("walk.obj", written.getvalue())):
        with pytest.raises(MeshError, match=r"walk\.") as refused:
            session.keep_poses(name, content)
        assert str(tmp_path) not in plain(refused.value, session.folder)
    assert not list((tmp_path / "session").iterdir())


def test_the_truth_of_clothes_comes_after_the_result_where_it_is_asked(
    legs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, transfers: Transfers
) -> None:
    meshes, draped = [load_mesh(path) for path in legs], list[Pose]()

    def mesh_of(figure: Figure, *, draped: bool = False) -> Mesh:
        return meshes[0]

    def truth_of(source: Figure, target: Figure) -> Mesh:
        draped.append(source.pose)
        return meshes[1]

    monkeypatch.setattr("workflows.demo.transfers.mesh_of", mesh_of)
    monkeypatch.setattr("workflows.demo.transfers.truth_of", truth_of)
    monkeypatch.setattr("workflows.demo.transfers.garments_of", lambda _: None)
    source, target = Figure(PERSON, (0.5,) * 6, Pose(1.0)), Figure(PERSON, (0.5,) * 6, outfit="coat")
    shown = list[tuple[float | None, bool]]()

    def show(outcome: Outcome) -> None:
        shown.append((outcome.frames[0].pmd, outcome.waits_for_draping))

    asked = Asked(source, target, Switches(force=True))
    transfers.run(asked, tmp_path / "work", lambda: False, show)
    assert shown == [(None, True)] and not draped
    transfers.run(replace(asked, draped=True), tmp_path / "work", lambda: False, show)
    assert shown[1] == (None, True) and shown[2][0] and not shown[2][1] and draped == [Pose(1.0)]
    transfers.run(replace(asked, draped=True), tmp_path / "work", lambda: True, show)  # a slider has moved on
    assert len(shown) == 4 and len(draped) == 1


def test_a_truth_that_cannot_be_draped_is_said_beside_the_result(
    legs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, transfers: Transfers, view: Seen
) -> None:
    def truth_of(source: Figure, target: Figure) -> Mesh:
        raise MeshError("the cloth is torn")

    monkeypatch.setattr("workflows.demo.transfers.mesh_of", lambda figure: load_mesh(legs[0]))
    monkeypatch.setattr("workflows.demo.transfers.truth_of", truth_of)
    monkeypatch.setattr("workflows.demo.transfers.garments_of", lambda _: None)
    session = Session(tmp_path / "s", transfers, view)
    source, target = Figure(PERSON, (0.5,) * 6, Pose(1.0)), Figure(PERSON, (0.5,) * 6, outfit="coat")
    session.ask(Asked(source, target, Switches(force=True), draped=True))
    view.wait()
    view.wait()
    session.close()
    outcome = session.outcome
    assert outcome is not None and not view.failures and outcome.frames[0].pmd is None
    assert "the cloth is torn" in legend(outcome, outcome.frames[0], 1.0, shown=True)
    assert not label(outcome, outcome.frames[0])


def test_a_sequence_of_too_many_vertices_is_refused(legs: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = load_mesh(legs[0])
    require_room(240, mesh, mesh)
    monkeypatch.setattr("workflows.demo.transfers.MOTION_LIMIT", 100)
    require_room(1, mesh, mesh)
    with pytest.raises(MeshError, match="the page plays 100: take fewer frames"):
        require_room(3, mesh, mesh)


@pytest.mark.parametrize(
    ("source", "places"),
    [
        (Figure(PERSON, (0.5,) * 6, Pose(1.0)), [0, 1, 2, 3, 2, 1, 0, 1]),
        ((Path("walk.zip"),), [0, 1, 2, 3, 0, 1, 2, 3]),
    ],
)
def test_the_way_between_random_poses_is_played_back_and_forth(source: Any, places: list[int]) -> None:
    def played(count: int) -> list[int]:
        outcome: Any = SimpleNamespace(frames=[None] * count, asked=SimpleNamespace(source=source))
        return [place_of(frame, outcome) for frame in range(8)]

    assert played(4) == places and played(1) == [0] * 8
