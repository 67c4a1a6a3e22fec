"""What a person looks for in MLflow's pages, in a real headless Chromium: each is three clicks away at most."""

import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.chromium import Browser, chromium
from tests.support.ranks import free_port
from tests.support.workflows import finished_workflow
from training.tracking.mlflow_mirror import publish
from training.tracking.mlflow_store import sqlite_server
from training.tracking.record import begin_record, end_record, update_record

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]
_ANYTHING = "a, button, label, div, span, [role=tab]"
_TICK = """(() => { const e = [...document.querySelectorAll('.ag-row')].filter(e => e.getClientRects().length)[%d]
    .querySelector('.ag-selection-checkbox input, input[type=checkbox]'); const r = e.getBoundingClientRect();
    return [r.x + r.width / 2, r.y + r.height / 2] })()"""


@pytest.fixture
def out(dataset: str, empty_store: Path, tmp_path: Path) -> Path:
    """A workflow's folder and its store, in which there is another run."""
    out, other = tmp_path / "tiny", tmp_path / "other"
    begin_record(other, name="other", kind="workflow", parent=None, parameters={"training.seed": "1"})
    update_record(other, metrics={"pmd_unseen": 7.25})
    end_record(other, "FINISHED")
    time.sleep(0.01)  # the list goes by milliseconds
    finished_workflow(Path(dataset), out)
    (out / "run/evaluation/viewer.html").write_text("<p id=turns>it turns</p>")
    update_record(out / "run", model="dsffnet", model_version="1", model_about="PMD 3.5e-4")
    update_record(
        out,
        artifacts=["run/evaluation/figures/training-curve.png", "run/evaluation/viewer.html"],
        metrics={"pmd_unseen": 3.5},
        tags={"mlflow.note.content": (out / "run/evaluation/tables.md").read_text()},
    )
    shutil.copy(empty_store, out / "mlflow.db")
    server = sqlite_server(out / "mlflow.db", own=True)
    for root in (other, out):
        publish(root, server)
    return out


@contextmanager
def ui(out: Path) -> Iterator[str]:
    """The address that the command prints for the runs."""
    command = [sys.executable, "-m", "workflows", "ui", str(out), "--port", str(free_port())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            yield next(found[1] for line in process.stdout if (found := re.match(r"runs +(http\S+)", line)))
        finally:
            process.terminate()


def test_table_pictures_viewer_model_and_a_comparison(out: Path, tmp_path: Path) -> None:
    with ui(out) as address, chromium(tmp_path / "browser") as page:

        def begin() -> None:
            page.open("about:blank")
            page.open(address)
            page.wait(lambda: page.run(f"{_TICK % 1!s}" if page.run("document.querySelectorAll('.ag-row').length > 1") else "0"))
            page.clicks = 0

        def click(words: str) -> None:
            page.wait(lambda: words in page.text().split("\n"))
            page.click(words, among=_ANYTHING)

        def clicked(shows: str) -> int:
            page.wait_for_text(shows)
            return page.clicks

        _open_first(page, address)
        begin()
        click("tiny")
        page.wait_for_text("target unchanged")
        click("Show more")
        assert clicked("source unchanged") == 2
        assert page.run("[...document.querySelectorAll('a')].some(e => /models\\/dsffnet\\/versions\\/1$/.test(e.href))")
        click("dsffnet")
