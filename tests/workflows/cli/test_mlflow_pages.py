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

from tests.support.ranks import free_port
from tests.support.workflows import finished_workflow
from tests.workflows.chromium import Browser, chromium
from training.tracking.mlflow_mirror import publish
from training.tracking.mlflow_store import sqlite_server
from training.tracking.record import begin_record, end_record, update_record

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]
_ANYTHING = "a, button, label, div, span, [role=tab]"
_BOXES = """[...document.querySelectorAll('.ag-row input[type=checkbox]')].map(e => e.getBoundingClientRect())
    .filter(r => r.width).map(r => [r.x + r.width / 2, r.y + r.height / 2])"""


@pytest.fixture
def out(dataset: str, empty_store: Path, tmp_path: Path) -> Path:
    """A workflow's folder and its store, in which there is an earlier run, too."""
    out, other = tmp_path / "tiny", tmp_path / "other"
    begin_record(other, name="other", kind="workflow", parent=None, parameters={"training.seed": "1"})
    update_record(other, metrics={"pmd_unseen": 7.25})
    end_record(other, "FINISHED")
    finished_workflow(Path(dataset), out)
    (out / "run/evaluation/viewer.html").write_text("<p>it turns</p>")
    update_record(out / "run", model="dsffnet", model_version="1", model_about="PMD 3.5e-4")
    update_record(
        out,
        artifacts=["run/evaluation/figures/training-curve.png", "run/evaluation/viewer.html"],
        metrics={"pmd_unseen": 3.5},
        tags={"mlflow.note.content": (out / "run/evaluation/tables.md").read_text()},
    )
    end_record(out, "FINISHED")
    shutil.copy(empty_store, out / "mlflow.db")
    for root in (other, out):
        publish(root, sqlite_server(out / "mlflow.db", own=True))
    return out


@contextmanager
def ui(out: Path) -> Iterator[str]:
    """The address of the runs, as the command prints it."""
    command = [sys.executable, "-m", "workflows", "ui", str(out), "--port", str(free_port())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            yield next(found[1] for line in process.stdout if (found := re.match(r"runs +(http\S+)", line)))
        finally:
            process.terminate()


@pytest.fixture
def page(out: Path, tmp_path: Path) -> Iterator[Browser]:
    """A tab with the list of runs."""
    with ui(out) as address, chromium(tmp_path / "browser") as page:
        page.wait(lambda: begun(page, address))
        yield page


def begun(page: Browser, address: str) -> bool:
    """Whether the list of runs is there within some seconds; MLflow's server takes a while."""
    page.open("about:blank")
    page.open(address)
    end = time.monotonic() + 30
    while time.monotonic() < end and len(page.run(_BOXES)) < 2:
        time.sleep(0.5)
    page.clicks = 0
    return len(page.run(_BOXES)) >= 2


def click(page: Browser, words: str) -> None:
    page.wait(lambda: words in (line.strip() for line in page.text().split("\n")))
    page.click(words, among=_ANYTHING)


def test_table_pictures_viewer_model_and_a_comparison(page: Browser) -> None:
    address = page.run("location.href")

    def leads_to(shows: str, *ways: str) -> int:
        assert begun(page, address)
        for way in ways:
            click(page, way)
        page.wait_for_text(shows)
        return page.clicks

    assert page.text().index("tiny") < page.text().index("other"), "the last run is the first"
    assert leads_to("source unchanged", "tiny", "Show more") == 2
    for artifact in ("training-curve.png", "viewer.html"):
        assert leads_to(f"artifacts/{artifact}", "tiny", "Artifacts", artifact) == 3
    assert leads_to("Registered models", "tiny") == 1
    version = "[...document.querySelectorAll('a')].some(e => e.href.endsWith('#/models/dsffnet/versions/1'))"
    page.wait(lambda: page.run(version))
    page.wait(lambda: begun(page, address))
    for place in range(2):
        page.click_at(*sorted(page.run(_BOXES), key=lambda at: at[1])[place])
        time.sleep(2)  # what is above moves the list
    click(page, "Compare")
    page.wait_for_text("Comparing 2 Runs")
    assert page.clicks == 3
