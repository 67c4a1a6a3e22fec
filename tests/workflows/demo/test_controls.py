"""The controls, as a browser would move them: joints that are remembered, files, and geometries to choose."""

import io
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
import viser

from tests.support.shapes.rigged_files import nodding
from workflows.demo.file_controls import MeshFileControls
from workflows.demo.pose_controls import JointControls, PoseControls
from workflows.demo.poses import Pose, read_poses


@pytest.fixture(scope="module")
def gui() -> Iterator[viser.GuiApi]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server.gui
    server.stop()


def test_degrees_are_kept_for_each_joint_until_they_are_reset(gui: viser.GuiApi) -> None:
    changes = list[None]()
    controls = JointControls(gui, lambda: changes.append(None))
    controls._sliders[2].value = 40.0
    controls._joint.value = "head"
    assert [slider.value for slider in controls._sliders] == [0, 0, 0]
    controls._sliders[0].value = -20.0
    controls._joint.value = "left shoulder"
    assert [slider.value for slider in controls._sliders] == [0, 0, 40]
    assert dict(controls.turns) == {"head": (-20, 0, 0), "left_shoulder": (0, 0, 40)}
    assert len(changes) == 2  # to look at another joint changes nothing
    controls._reset()
    assert not controls.turns and not any(slider.value for slider in controls._sliders) and len(changes) == 3


def test_poses_are_those_of_the_file_as_long_as_it_is_chosen(gui: viser.GuiApi, tmp_path: Path) -> None:
    def keep(name: str, content: bytes) -> Any:
        (tmp_path / name).write_bytes(content)
        return read_poses(tmp_path / name)

    failures = list[str]()
    controls = PoseControls(gui, Pose(7.0), is_source=True, keep=keep, changed=lambda: None, failed=failures.append)
    controls._from.value = "my own (.npz)"
    assert controls.pose == Pose(7.0)  # until there is a file
    written = io.BytesIO()
    np.savez(written, poses=np.zeros((4, 66)))
    files: Any = controls._files
    files._receive(SimpleNamespace(name="walk.npz", content=b"none"))
    files._receive(SimpleNamespace(name="walk.npz", content=written.getvalue()))
    assert len(failures) == 1 and "cannot be read as .npz" in failures[0]
    assert "**walk**, 4 poses" in files.about.content
    place: Any = controls._place
    place.value = 3
    assert controls.pose.name == "walk-3"
    controls.arrange(is_shown=True, is_person=False)
    assert controls.pose == Pose(7.0) and not files.folder.visible
    controls.arrange(is_shown=True, is_person=True)
    controls._from.value = "random"
    assert controls.pose == Pose(7.0)


def solids(**places: float) -> bytes:
    """A GLB of balls along X."""
    scene = trimesh.Scene()
    for name, place in places.items():
        ball = trimesh.creation.icosphere(subdivisions=1)
        scene.add_geometry(ball.apply_translation([place, 0, 0]), node_name=name, geom_name=name)
    content: bytes = scene.export(file_type="glb")
    return content


@pytest.fixture
def mesh_controls(gui: viser.GuiApi, tmp_path: Path) -> tuple[MeshFileControls, list[str]]:
    def keep(name: str, content: bytes) -> tuple[Path, ...]:
        (tmp_path / name).write_bytes(content)
        return (tmp_path / name,)

    failures = list[str]()
    made = MeshFileControls(
        gui, "meshes", accepted=".glb", keep=keep, changed=lambda: None, failed=failures.append, plays=True
    )
    return made, failures


def test_geometries_of_one_body_are_all_taken_until_some_are_left_out(
    mesh_controls: tuple[MeshFileControls, list[str]],
) -> None:
    controls, failures = mesh_controls
    assert controls.files == ()
    controls._receive(SimpleNamespace(name="one.glb", content=solids(body=0.0, hat=1.0, shoe=-1.0)))  # type: ignore[arg-type]
    assert controls.files and controls.geometries == () and not failures
    controls._boxes["hat"].value = False
    assert controls.geometries == ("body", "shoe")
    controls._receive(SimpleNamespace(name="ball.glb", content=solids(ball=0.0)))  # type: ignore[arg-type]
    assert controls.files and controls.geometries == () and not controls._boxes


def test_geometries_apart_wait_for_a_choice(mesh_controls: tuple[MeshFileControls, list[str]]) -> None:
    controls, failures = mesh_controls
    controls._receive(SimpleNamespace(name="two.glb", content=solids(body=0.0, lamp=9.0)))  # type: ignore[arg-type]
    assert controls.files == () and "do not make one body" in failures[0]
    controls._boxes["body"].value = True
    assert controls.files and controls.geometries == ("body",)
    controls._boxes["lamp"].value = True
    assert controls.geometries == ("body", "lamp")  # both are named, else they would be refused


def test_animations_of_a_source_are_offered_and_the_first_is_played(
    mesh_controls: tuple[MeshFileControls, list[str]], gui: viser.GuiApi, tmp_path: Path
) -> None:
    controls, failures = mesh_controls
    content = nodding(tmp_path / "made.glb").read_bytes()
    controls._receive(SimpleNamespace(name="a.glb", content=content))  # type: ignore[arg-type]
    assert controls.animation == "Nod" and not failures
    controls._animation.value = "Kick"  # type: ignore[union-attr]
    assert controls.animation == "Kick"
    controls._animation.value = "none: at rest"  # type: ignore[union-attr]
    assert controls.animation is None
    controls._receive(SimpleNamespace(name="ball.glb", content=solids(ball=0.0)))  # type: ignore[arg-type]
    assert controls.animation is None and controls._animation is None
    target = MeshFileControls(
        gui, "", accepted=".glb", keep=controls._keep, changed=lambda: None, failed=failures.append, plays=False
    )
    target._receive(SimpleNamespace(name="a.glb", content=content))  # type: ignore[arg-type]
    assert target.files and target.animation is None
