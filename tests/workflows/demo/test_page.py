"""The page in a real headless Chromium: upload, transfer, download, what is refused, and memory that stays."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
import trimesh

from datagen.characters.motion import animation_names
from datagen.mesh.files import load_mesh, read_mesh_file, save_mesh
from datagen.mesh.sequences import write_animation
from tests.workflows.chromium import Browser, chromium
from workflows.demo.bodies import mesh_of, random_figure
from workflows.demo.poses import PERSON
from workflows.demo.uploads import BYTE_LIMIT

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]
_SMALL = (760, 560)  # pixels, which software draws
_TRANSFERS, _GROWTH = 20, 10 * 2**20  # bytes, of fifteen transfers; a mesh kept of each would be more


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder, random = tmp_path_factory.mktemp("people"), np.random.default_rng(5)
    for name in ("pose", "person"):
        save_mesh(mesh_of(random_figure(PERSON, random, "notoes_collapse5pc")), folder / f"{name}.obj")
    return [folder / "pose.obj", folder / "person.obj"]


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[str, psutil.Process]]:
    """The command as a person starts it; its temporary files are in ``tmp_path/temporary``."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    command = [sys.executable, "-m", "workflows", "demo", "--port", str(port)]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"TMPDIR": str(temporary)},
    ) as process:
        try:
            assert process.stdout is not None
            address = next(line for line in process.stdout if "http://" in line)
            assert f"http://127.0.0.1:{port}" in address
            yield f"http://127.0.0.1:{port}", psutil.Process(process.pid)
        finally:
            process.send_signal(signal.SIGINT)
            assert "what was uploaded is removed" in process.communicate(timeout=240)[0]
    assert process.returncode == 130 and not list(temporary.iterdir())


@pytest.fixture
def page(server: tuple[str, psutil.Process], tmp_path: Path) -> Iterator[Browser]:
    with chromium(tmp_path / "browser") as browser:
        browser.open(server[0], size=_SMALL)
        browser.wait_for_text("by the weights human")
        yield browser


def choose_own(page: Browser, tab: str, mesh: Path, *, dropped: bool = False) -> None:
    page.click(tab)
    page.choose("Body", "my own mesh")
    (page.drop_file if dropped else page.choose_file)(mesh)
    page.wait_for_text(f"{mesh.name}. Another file")


def posed(page: Browser) -> str:
    """What the page says of the transfer; it takes as long as that."""
    return str(page.wait(lambda: re.search(r"([\d,]+) vertices in [\d.]+ s", page.text()))[1])


def is_disabled(page: Browser, button: str) -> bool:
    """Whether a button cannot be pressed."""
    return bool(
        page.run(f"[...document.querySelectorAll('button')].find(e => e.innerText.trim() === '{button}').disabled")
    )


def downloaded(page: Browser, name: str) -> bool:
    """Whether a download brings the result of that name, which is there as soon as it is posed."""
    page.click("Download OBJ")
    time.sleep(1)
    return (page.downloads / name).exists()


def test_upload_transfer_download_refusals_and_memory(
    page: Browser, server: tuple[str, psutil.Process], meshes: list[Path], tmp_path: Path
) -> None:
    choose_own(page, "Source", meshes[0])
    choose_own(page, "Target", meshes[1], dropped=True)
    page.wait(lambda: posed(page) == "615")

    page.click("Download OBJ")
    result = page.downloads / "person-posed.obj"
    page.wait(result.exists)
    before, after = load_mesh(meshes[1]), load_mesh(result)
    assert np.array_equal(before.faces, after.faces)
    assert np.abs(before.vertices - after.vertices).max() > 0.02

    page.click("Play")
    page.wait_for_text("Not posed. pose.obj is one mesh: frames to play come as a .zip")
    assert is_disabled(page, "Download OBJ") and is_disabled(page, "Download GLB")
    page.click("Play")
    page.wait(lambda: posed(page) == "615")
    assert not is_disabled(page, "Download OBJ")

    broken = tmp_path / "broken.obj"
    broken.write_bytes(meshes[0].read_bytes().replace(b"f 1", b"f 99999", 1))
    page.choose_file(broken)
    page.wait_for_text("That cannot be posed")
    page.wait_for_text("Not posed. broken.obj cannot be read as OBJ: a face names vertex 99999")
    assert str(tmp_path) not in page.text()

    large, resident = tmp_path / "large.obj", server[1].memory_info().rss
    with large.open("wb") as file:
        file.truncate(200 * 2**20)
    page.choose_file(large)
    page.wait_for_text(f"large.obj has 200 MB, the page takes {BYTE_LIMIT // 2**20}")
    time.sleep(3)
    assert server[1].memory_info().rss - resident < BYTE_LIMIT

    sizes = []
    for number in range(_TRANSFERS):
        again = tmp_path / f"again{number}.obj"
        again.write_bytes(meshes[1].read_bytes())
        page.choose_file(again)
        page.wait(lambda name=f"again{number}-posed.obj": downloaded(page, name))
        sizes.append(server[1].memory_info().rss)
    assert sizes[-1] - sizes[4] < _GROWTH, [size >> 20 for size in sizes]
    assert not [url for url in page.requests if not url.startswith((server[0], "data:", "blob:"))]


def test_clothes_poses_of_a_file_and_geometries(page: Browser, meshes: list[Path], tmp_path: Path) -> None:
    page.choose("Mesh", "615 vertices")
    page.click("Target")
    page.choose("Mesh", "615 vertices")
    page.choose("Outfit", "tight")
    page.wait(lambda: posed(page) not in ("615", "12,272"))
    page.click("Error map")
    page.wait_for_text("99th percentile and above")

    walk, frames = tmp_path / "walk.npz", np.zeros((8, 66))
    frames[:, 0], frames[:, 3] = np.pi / 2, np.linspace(-1, 1, 8)  # Z up, as in AMASS
    np.savez(walk, poses=frames)
    page.click("Source")
    page.choose("Poses", "my own (.npz)")
    page.choose_file(walk)
    page.wait_for_text("walk, 8 poses")
    page.click("Play")
    page.wait_for_text("8 of 8 frames")
    page.wait_for_text("is not made of what is played")
    page.click("Play")

    body = load_mesh(meshes[1])
    scene = trimesh.Scene()
    for name, place in (("person", 0.0), ("lamp", 5.0)):
        solid = trimesh.Trimesh(body.vertices, body.faces, process=False).apply_translation([place, 0, 0])
        scene.add_geometry(solid, node_name=name, geom_name=name)
    two = tmp_path / "two.glb"
    two.write_bytes(scene.export(file_type="glb"))
    choose_own(page, "Target", two)
    page.wait_for_text("Not posed. two.glb holds 2 geometries")
    page.click("person")
    page.wait(lambda: posed(page) == "615")


def test_an_animated_glb_is_played_and_comes_back_as_an_animation(
    page: Browser, meshes: list[Path], tmp_path: Path
) -> None:
    walk = tmp_path / "walk.glb"
    still, moved = (load_mesh(path).vertices for path in meshes)
    write_animation(read_mesh_file(meshes[0]), [still, (still + moved) / 2, still], walk, frames_per_second=15)
    choose_own(page, "Target", meshes[1])
    choose_own(page, "Source", walk)
    page.wait_for_text("3 of 3 frames, 615 vertices")
    page.click("Download GLB")
    result = page.downloads / "person-posed.glb"
    page.wait(result.exists)
    assert animation_names(result) == ("poses",)
    page.choose("Animation", "none: at rest")
    page.wait(lambda: "frames" not in page.text())


def test_two_people_do_not_see_each_others_meshes(
    page: Browser, server: tuple[str, psutil.Process], meshes: list[Path], tmp_path: Path
) -> None:
    choose_own(page, "Target", meshes[1])
    folder = next((tmp_path / "temporary").iterdir())
    with chromium(tmp_path / "other") as other:
        other.open(server[0], size=_SMALL)
        other.wait_for_text("by the weights human")
        assert "person.obj" in page.text() and "person.obj" not in other.text()
        assert len(list(folder.iterdir())) == 2
    page.wait(lambda: len(list(folder.iterdir())) == 1)
