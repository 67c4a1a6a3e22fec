"""Following a training: lines in a log, a bar on a terminal."""

import os
import pty
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from training.tracking.journal import Journal, read_journal
from workflows.pipeline import progress
from workflows.pipeline.progress import bar, following

ROOT = Path(__file__).parents[3]


def write(journal: Journal, first: int, last: int, pause: float = 0.0) -> None:
    for step in range(first, last):
        journal.write(step, {"loss/total": 1 / step, "meshes_per_second": 100.0, "evaluation/pmd_unseen": step * 1e-4})
        time.sleep(pause)


def test_a_log_gets_lines_and_no_control_characters(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "_QUIET_SECONDS", 0.6)
    journal = Journal(tmp_path / "m.jsonl")
    with following(tmp_path / "m.jsonl", steps=60, steps_per_epoch=20):
        write(journal, 1, 61, pause=0.05)
    lines = capfd.readouterr().err.splitlines()
    assert 3 <= len(lines) <= 8, lines
    assert all(re.fullmatch(r"train: [ -~]+", line) for line in lines), lines
    assert lines[-1] == "train: epoch 3/3, step 60/60, loss 0.01667, PMD unseen 60.0e-4, best 1.0e-4, 100 meshes/s"
    assert any(re.search(r"\d s left$", line) for line in lines[:-1])


def test_a_resumed_training_is_followed_from_where_it_is(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    journal = Journal(tmp_path / "m.jsonl")
    write(journal, 1, 31)
    with following(tmp_path / "m.jsonl", steps=60):
        write(journal, 31, 33)
    lines = capfd.readouterr().err.splitlines()  # two where the rows were seen one by one
    assert len(lines) in (1, 2) and lines[-1].startswith("train: step 32/60")
    assert lines[0].startswith("train: step 3")
    assert [row["step"] for row in read_journal(tmp_path / "m.jsonl")] == list(range(1, 33))


def test_a_training_that_fails_at_once_leaves_no_thread_and_no_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(RuntimeError), following(tmp_path / "m.jsonl", steps=60):
        raise RuntimeError("no such dataset")
    assert capfd.readouterr().err == ""


ON_A_TERMINAL = """
import sys, time
from pathlib import Path
from training.tracking.journal import Journal
from workflows.pipeline.progress import following
path = Path(sys.argv[1])
journal = Journal(path)
with following(path, steps=40, steps_per_epoch=10):
    for step in range(1, 41):
        journal.write(step, {"loss/total": 1 / step, "meshes_per_second": 100.0})
        time.sleep(0.05)
"""


@pytest.mark.parametrize("columns", [60, 120])
def test_a_terminal_gets_a_bar_that_fits(tmp_path: Path, columns: int) -> None:
    controller, terminal = pty.openpty()
    subprocess.run(["stty", "rows", "40", "cols", str(columns)], stdin=terminal, check=True)
    command = [sys.executable, "-c", ON_A_TERMINAL, str(tmp_path / "m.jsonl")]
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    environment |= {"PYTHONPATH": str(ROOT), "TERM": "xterm"}
    process = subprocess.Popen(command, stderr=terminal, stdout=terminal, stdin=terminal, env=environment)
    os.close(terminal)
    shown = b""
    while process.poll() is None:
        shown += read_all(controller)
    shown += read_all(controller)
    assert process.returncode == 0, shown
    drawings = [line for line in re.split(r"[\r\n]+", shown.decode()) if line.strip()]
    assert len(drawings) > 2 and max(map(len, drawings)) <= columns, drawings
    assert re.search(r"train 100%\|.+\| .*step 40/40", drawings[-1]), drawings
    assert any(" left" in line for line in drawings)


def read_all(controller: int) -> bytes:
    try:
        return os.read(controller, 65536)
    except OSError:  # the other end is closed
        return b""


def test_counting_bars_are_lines_in_a_log_too(capfd: pytest.CaptureFixture[str]) -> None:
    with bar(total=3, what="generate", unit="mesh") as shown:
        shown.update(3)
    lines = capfd.readouterr().err.splitlines()
    assert lines and all(re.fullmatch(r"[ -~]+", line) for line in lines), lines
