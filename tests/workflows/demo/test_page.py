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

from datagen.mesh.files import load_mesh, save_mesh
from tests.support.chromium import Browser, chromium
from workflows.demo.bodies import PERSON, mesh_of, random_figure
from workflows.demo.uploads import BYTE_LIMIT

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]
_SMALL, _LONG = (760, 560), 240  # pixels, which software draws; seconds, on a machine that has other work
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
            assert "what was uploaded is removed" in process.communicate(timeout=60)[0]
    assert process.returncode == 130 and not list(temporary.iterdir())


@pytest.fixture
def page(server: tuple[str, psutil.Process], tmp_path: Path) -> Iterator[Browser]:
    with chromium(tmp_path / "browser") as browser:
        browser.open(server[0], size=_SMALL)
        browser.wait_for_text("by the weights human", seconds=_LONG)
        yield browser


def choose_own(page: Browser, tab: str, mesh: Path) -> None:
    page.click(tab)
    page.choose("Body", "my own mesh")
    page.wait(lambda: page.has_file_input)
    page.choose_file(mesh)
    page.wait_for_text(f"{mesh.name}. Another file", seconds=_LONG)


def posed(page: Browser) -> str:
    """What the page says of the transfer; it takes as long as that."""
    return str(page.wait(lambda: re.search(r"([\d,]+) vertices in [\d.]+ s", page.text()), seconds=_LONG)[1])


def downloaded(page: Browser, name: str) -> bool:
    """Whether a download brings the result of that name, which is there as soon as it is posed."""
    page.click("Download OBJ")
    time.sleep(1)
    return (page.downloads / name).exists()


def test_upload_transfer_download_refusals_and_memory(
    page: Browser, server: tuple[str, psutil.Process], meshes: list[Path], tmp_path: Path
) -> None:
    choose_own(page, "Source", meshes[0])
    choose_own(page, "Target", meshes[1])
    page.wait(lambda: posed(page) == "615", seconds=_LONG)

    page.click("Download OBJ")
    result = page.downloads / "person-posed.obj"
    page.wait(result.exists, seconds=_LONG)
    before, after = load_mesh(meshes[1]), load_mesh(result)
    assert np.array_equal(before.faces, after.faces)
    assert np.abs(before.vertices - after.vertices).max() > 0.02

    broken = tmp_path / "broken.obj"
    broken.write_bytes(meshes[0].read_bytes().replace(b"f 1", b"f 99999", 1))
    page.choose_file(broken)
    page.wait_for_text("That cannot be posed", seconds=_LONG)
    page.wait_for_text("Not posed. broken.obj cannot be read as OBJ: a face names vertex 99999", seconds=_LONG)
    assert str(tmp_path) not in page.text()

    large, resident = tmp_path / "large.obj", server[1].memory_info().rss
    with large.open("wb") as file:
        file.truncate(200 * 2**20)
    page.choose_file(large)
    page.wait_for_text(f"large.obj has 200 MB, the page takes {BYTE_LIMIT // 2**20}", seconds=_LONG)
    time.sleep(3)
    assert server[1].memory_info().rss - resident < BYTE_LIMIT

    sizes = []
    for number in range(_TRANSFERS):
        again = tmp_path / f"again{number}.obj"
        again.write_bytes(meshes[1].read_bytes())
        page.choose_file(again)
        page.wait(lambda name=f"again{number}-posed.obj": downloaded(page, name), seconds=_LONG)
        sizes.append(server[1].memory_info().rss)
    assert sizes[-1] - sizes[4] < _GROWTH, [size >> 20 for size in sizes]
    assert not [url for url in page.requests if not url.startswith((server[0], "data:", "blob:"))]


def test_two_people_do_not_see_each_others_meshes(
    page: Browser, server: tuple[str, psutil.Process], meshes: list[Path], tmp_path: Path
) -> None:
    choose_own(page, "Target", meshes[1])
    folder = next((tmp_path / "temporary").iterdir())
    with chromium(tmp_path / "other") as other:
        other.open(server[0], size=_SMALL)
        other.wait_for_text("by the weights human", seconds=_LONG)
        assert "person.obj" in page.text() and "person.obj" not in other.text()
        assert len(list(folder.iterdir())) == 2
    page.wait(lambda: len(list(folder.iterdir())) == 1)
