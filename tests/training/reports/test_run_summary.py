"""The report of a workflow: from what a folder holds, nothing else, and nothing of the machine's own places."""

import json
import os
import shutil
import socket
from pathlib import Path

import pytest

from datagen.common.errors import DatasetError
from tests.support.workflows import finished_workflow
from training.evaluation.evaluate import read_rows
from training.evaluation.tables import mean_of
from training.reports.report import (
    NAMES,
    Code,
    Facts,
    ReportError,
    Table,
    report_is_current,
    what_was_run,
    workflow_report,
)
from training.reports.run_summary import COMMAND_TAG, duration, moment
from training.tracking.provenance import this_machine
from training.tracking.record import end_record, read_record, update_record


@pytest.fixture(scope="module")
def finished(_pristine: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished") / "out"
    finished_workflow(_pristine, out)
    return out


@pytest.fixture
def out(finished: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(finished, tmp_path / "a run"))


def facts_of(out: Path) -> dict[str, str]:
    (facts,) = [block for block in what_was_run(out).body if isinstance(block, Facts)]
    return {name: fact.text if isinstance(fact, Code) else str(fact) for name, fact in facts.facts.items()}


def stages_of(out: Path) -> list[dict[str, str]]:
    (table,) = [block for block in what_was_run(out).body if isinstance(block, Table)]
    return [dict(zip(table.lines[0], line, strict=True)) for line in table.lines[1:]]


def test_the_report_tells_the_table_the_curve_and_both_cards(out: Path) -> None:
    rows = read_rows(out / "run/evaluation/rows.csv")
    html, markdown = (path.read_text(encoding="utf-8") for path in workflow_report(out))
    for word in ("What was run", "Results", "Training", "Dataset card", "Model card", "Files", "Limits"):
        assert f">{word}</h" in html and f"# {word}\n" in markdown
    score = f"{mean_of(rows, method='DSFFNet', pose_type='unseen', field='pmd') * 1e4:.2f}"
    assert html.count(score) >= 2 and f"**PMD {score} x 1e-4" in markdown, "in the lead and in the table"
    assert "](run/evaluation/figures/training-curve.png)" in markdown and html.count("<img ") == 1
    assert "Examples" not in markdown.replace("examples", ""), "no viewer and no example was drawn"


def test_a_report_names_no_place_of_the_machine(out: Path) -> None:
    for path in workflow_report(out):
        assert str(out.parent) not in path.read_text(encoding="utf-8")


def test_the_command_is_shown_without_places_and_passwords(out: Path) -> None:
    record = read_record(out)
    assert record is not None
    update_record(out, tags={name: value for name, value in record.tags.items() if name != COMMAND_TAG})
    assert "command" not in facts_of(out)
    command = f"python workflows/full.py --out {out.resolve()} --set data.body.path=/home/me/models/a.npz "
    update_record(out, tags=record.tags | {COMMAND_TAG: command + "--tracking-uri https://me:secret@host:5000/x"})
    shown = "python workflows/full.py --out a run --set data.body.path=a.npz --tracking-uri https://host:5000/x"
    assert facts_of(out)["command"] == shown


def test_stages_come_in_their_order_with_their_times_and_loads(out: Path) -> None:
    load = [{"step": step, "time": 0, "system/cpu_utilization_percentage": 40 + 20 * step} for step in (0, 1)]
    (out / "run/system.jsonl").write_text("".join(json.dumps(row) + "\n" for row in load))
    train, evaluate = stages_of(out)
    assert (train["stage"], train["folder"], train["took"]) == ("train", "run", "1 min 1 s")
    assert (evaluate["folder"], evaluate["status"]) == ("run/evaluation", "finished")
    assert (train["CPU %, mean"], evaluate["CPU %, mean"]) == ("50", "")
    assert "GPU %, mean" not in train, "no column without a value"


def test_a_mark_of_an_earlier_command_is_not_taken_for_the_time_of_the_last(out: Path) -> None:
    record = read_record(out / "run")
    assert record is not None and record.ended is not None
    update_record(out / "run", started=record.ended - 7000)
    os.utime(out / "stages/train.json", (0, 0))
    assert stages_of(out)[0]["took"] == "7.0 s"


def test_a_clock_that_was_put_back_gives_no_negative_time(out: Path) -> None:
    for folder in (out, out / "run"):
        record = read_record(folder)
        assert record is not None
        update_record(folder, status="FINISHED", ended=record.started - 86_400_000)
    os.utime(out / "stages/train.json", (0, 0))
    assert stages_of(out)[0]["took"] == "" and "after it began" not in facts_of(out)["status"]
    assert not any("-86400" in path.read_text(encoding="utf-8") for path in workflow_report(out))


def test_a_workflow_that_still_runs_says_so_and_a_finished_one_how_long_it_took(out: Path) -> None:
    assert facts_of(out)["status"].startswith("stages finished 20"), "it is the workflow itself that writes its report"
    update_record(out / "run", status="KILLED")
    assert facts_of(out)["status"].startswith("still running")
    end_record(out, "FINISHED")
    assert facts_of(out)["status"].startswith("finished 20")


def test_the_software_and_machine_of_the_training_are_told_where_they_were_noted(out: Path) -> None:
    assert "commit of this report" in facts_of(out) and "machine of this report" in facts_of(out)
    noted = {"git_commit": "abc", "hardware": {"processor": "an abacus", "GPU": "none"}}
    (out / "run/provenance.json").write_text(json.dumps(noted))
    assert (facts_of(out)["commit"], facts_of(out)["machine"]) == ("abc", "an abacus; none")


def test_a_report_is_current_until_the_evaluation_is_made_anew(out: Path) -> None:
    assert not report_is_current(out)
    workflow_report(out)
    assert report_is_current(out)
    os.utime(out / NAMES[1], (0, 0))
    assert not report_is_current(out)


def test_what_is_missing_is_named(out: Path, tmp_path: Path) -> None:
    with pytest.raises(ReportError, match=r"no record\.json"):
        workflow_report(tmp_path / "nothing")
    with pytest.raises(ReportError, match=r"no record\.json"):
        what_was_run(tmp_path / "nothing")
    (out / "dataset.zarr").rename(out / "moved.zarr")
    with pytest.raises(DatasetError, match=r"dataset\.zarr"):
        workflow_report(out)
    (out / "run/evaluation/rows.csv").unlink()
    with pytest.raises(ReportError, match=r"no run/evaluation/rows\.csv"):
        workflow_report(out)
    assert not any((out / name).exists() for name in NAMES)


def test_times_are_told_as_people_say_them() -> None:
    told = [duration(seconds) for seconds in (0.44, 9.3, 41.2, 402, 3599.7, 11100)]
    assert told == ["0.4 s", "9.3 s", "41 s", "6 min 42 s", "1 h", "3 h 5 min"]
    assert moment(1795268514690) == "2026-11-21 13:41:54 UTC"


def test_a_machine_is_told_without_its_name() -> None:
    facts = this_machine()
    assert {"processor", "memory", "system"} <= facts.keys() and all(facts.values())
    assert socket.gethostname() not in " ".join(facts.values()).split()
