"""Names that somebody else chose (files, folders, methods, descriptions) wherever a person looks: inert text.

Pages hold no element of theirs, Markdown and CSV run nothing, pictures are drawn, terminals obey nothing, MLflow takes
them; nothing crashes, be a name 5,000 letters long or no UTF-8 at all.
"""

import csv
import json
import logging
import re
import shlex
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import mlflow
import numpy as np
import pytest
import yaml

from datagen.common.errors import MeshError
from datagen.common.printable import printable, printable_lines
from datagen.store import open_dataset
from tests.support.recipes import tiny_training
from tests.support.reports.pages import Elements
from tests.support.workflows import finished_workflow, rows_on
from training.evaluation.document import Table, Text, document_markdown, plain, table_markdown
from training.evaluation.generalisation import GeneralisationRow
from training.evaluation.results import Row, inert, read_csv, read_piece, write_csv, write_rows
from training.evaluation.robustness import RobustnessRow
from training.evaluation.run_curves import RunCurve
from training.evaluation.tables import report
from training.reports.blocks import Facts, Section
from training.reports.cards import dataset_card, model_card
from training.reports.plots.ablation import ablation_figure
from training.reports.plots.convergence import convergence_figure
from training.reports.plots.generalisation import heat_map
from training.reports.plots.robustness import robustness_curves
from training.reports.plots.sweep import sweep_figure
from training.reports.plots.training_curve import training_curve
from training.reports.report import Code, workflow_report, write_report
from training.tracking.journal import read_journal
from training.tracking.mlflow_mirror import publish
from training.tracking.record import EXPERIMENT, Server, begin_record, end_record, read_record, update_record
from training.viz.comparison_figure import comparison_figure
from training.viz.transfer_example import Comparison, NamedMesh
from training.viz.viewer import write_viewer
from workflows.pipeline.console import guarded, print_facts
from workflows.studies.sweep.plan import plan_sweep
from workflows.studies.sweep.report import parts_of, results_of, table_csv

SCRIPT = '"><script>alert(1)</script><img src=x onerror=alert(1)></title><!-- --><style>'
MARKUP = "![x](http://evil.example/t.png) [y](javascript:alert(1)) | `|` **b** <b> \\ # -"
TERMINAL = "\x1b]0;owned\x07\x1b[31mred\x1b[2J\r\x9b1mline\nerror: another"
BYTES = "undecodable \udcff\udc80 and a half pair \ud83d"
REVERSED = "invoice \u202egpj.exe\u2066"
HOSTILE = [SCRIPT, MARKUP, TERMINAL, BYTES, REVERSED, "=cmd|'/C calc'!A1", "$x^", "\\frac{$", "_hidden", "x" * 5000]
ALL = " ".join(HOSTILE)
UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 1.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def assert_inert_page(page: str, *, like: str) -> Elements:
    """A page with the elements of one without hostile names, and with nothing that does not print."""
    found = Elements(page)
    assert found.tags == Elements(like).tags and not found.handlers
    assert not UNPRINTABLE.search(page)
    return found


def assert_inert_markdown(text: str, *, own_links: str = "a^") -> None:
    """Markdown without elements, pictures and links of others; code shows what it holds."""
    outside = re.sub(r"(`{3,}).*?\1|`[^`\n]*`", "", text.replace("\\`", ""), flags=re.DOTALL)
    assert not re.search(r"<(?!/?(details|summary)>)", outside) and not UNPRINTABLE.search(text)
    links = [link for link in re.findall(r"(?<!\\)\]\(([^)]*)\)", outside) if not re.match(own_links, link)]
    assert not links, links


def comparison(method: str, title: str, name: str) -> Comparison:
    mesh = NamedMesh(CORNERS, FACES, name)
    return Comparison(title, mesh, mesh, {method: mesh, "other": mesh}, mesh, {method: title})


@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_prints_as_one_line_and_says_what_it_is(name: str) -> None:
    shown = printable(name)
    assert "\n" not in shown and not UNPRINTABLE.search(shown)
    assert shown.encode().decode() == shown
    assert printable(shown) == shown and (UNPRINTABLE.search(name) or shown == name)
    assert printable_lines("a\n\tb") == "a\n\tb" and printable("日本é 😀 \u2028") == "日本é 😀 \u2028"


@pytest.mark.parametrize("name", HOSTILE)
def test_reports_show_it_as_text(tmp_path: Path, name: str) -> None:
    def written(name: str) -> tuple[str, str]:
        blocks = (
            Table([["a", name], [name, "1"]], plain(name), plain(name)),
            Facts({name: name, "hash": Code(name)}),
            Code(name, folded=name),
            Text(plain(name)),
        )
        paths = write_report(tmp_path, title=name, lead=plain(name), sections=[Section(name, blocks)])
        html, text = (path.read_text(encoding="utf-8") for path in paths)
        return html, text

    html, text = written(name)
    found = assert_inert_page(html, like=written("harmless")[0])
    assert " ".join(printable_lines(name).split()) in " ".join(found.text.split())
    assert_inert_markdown(text)


def test_the_report_of_a_workflow_of_hostile_names(
    _pristine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folder, description, command, method and assets; and what is to be copied into a shell stays one word there."""
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "$(touch owned); `x` <script>'\""
    finished_workflow(_pristine, out)
    (out / "recipe.yaml").write_text(yaml.safe_dump({"description": ALL}))
    rows = [
        replace(row, method=MARKUP) if row.method == "DSFFNet" else row
        for row in rows_on(open_dataset(str(out / "dataset.zarr")))
    ]
    write_rows(rows, out / "run" / "evaluation" / "rows.csv")
    text = report(rows, title="Legs", about=plain(ALL), emd_points=16)
    (out / "run" / "evaluation" / "tables.md").write_text(text)
    record = read_record(out)
    update_record(out, name=ALL, tags=record.tags | {"dsffnet.command": ALL})
    html, markdown_file = workflow_report(out)
    found = Elements(html.read_text(encoding="utf-8"))
    assert found.tags.count("script") == 1 and not found.handlers and not UNPRINTABLE.search(html.read_text())
    assert_inert_markdown(
        markdown_file.read_text(encoding="utf-8"), own_links=r"run/|generate/|https://github.com/naver"
    )
    dataset, usage = open_dataset(str(out / "dataset.zarr")), model_card(out, open_dataset(str(out / "dataset.zarr")))
    (commands,) = [block.text for block in usage.body if isinstance(block, Code) and "dsffnet transfer" in block.text]
    assert shlex.split(commands.splitlines()[1])[3] == f"{out.name}/run"
    assert f"from_run({json.dumps(out.name + '/run')})" in commands
    shutil.move(dataset.url, out / "a; touch owned.zarr")
    moved = dataset_card(open_dataset(str(out / "a; touch owned.zarr")))
    (again,) = [block.text for block in moved.body if isinstance(block, Code) and "generate --recipe" in block.text]
    assert shlex.split(again.splitlines()[0])[3] == "a; touch owned.zarr"


@pytest.mark.parametrize("name", HOSTILE)
def test_the_viewer_shows_it_as_text(tmp_path: Path, name: str) -> None:
    page, like = (
        write_viewer([comparison(word, word, word)], tmp_path / "v.html", title=word).read_text(encoding="utf-8")
        for word in (name, "harmless")
    )
    found = Elements(page)
    assert found.tags == Elements(like).tags and not found.handlers and not UNPRINTABLE.search(page.split("<script")[0])
    data = json.loads(re.search(r'<script[^>]*id="data"[^>]*>(.*?)</script>', page, re.DOTALL)[1])  # type: ignore[index]
    (example,) = data["examples"]
    assert example["title"] == example["source"]["name"] == data["methods"][0]["name"] == printable(name)
    assert printable(name) in example["outputs"] and printable(name) in example["errors"]


def test_pictures_are_drawn_whatever_they_are_called(tmp_path: Path) -> None:
    """Neither mathematics that does not parse, nor letters that no font and no encoding has, nor their number."""
    some, numbers, draw = [BYTES, "$x^", TERMINAL, "日本" * 130], [0.01] * 8, tmp_path / "drawn"
    cells = [
        GeneralisationRow(method, kind, kind, 0, 0, 0, 0, 0, 4, 4, *numbers)
        for kind in map(printable, some)
        for method in (ALL, "target unchanged")
    ]
    disturbed = [
        RobustnessRow(name, "noise", amount, 0, 0, 0, 0, 0, 4, *numbers) for name in some for amount in (0.0, 0.01)
    ]
    places, falling = np.array([1.0, 2]), np.array([0.02, 0.01])
    rows = [Row(name, "unseen", place, 0, 0, 0, 0, *numbers) for name in some[:2] for place in range(2)]
    run = tmp_path / "run"
    run.mkdir()
    (run / "recipe.yaml").write_text(yaml.safe_dump(tiny_training().model_dump(mode="json")))
    line = {"time": 1, "loss/reconstruction": 0.1, "evaluation/pmd_unseen": 0.1, "meshes_per_second": 5}
    (run / "metrics.jsonl").write_text("".join(json.dumps({"step": step} | line) + "\n" for step in (1, 2)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        comparison_figure([comparison("\n".join(HOSTILE), ALL, ALL)], draw / "comparison.png", panel=(60, 60))
        heat_map(cells, list(map(printable, some)), draw / "heat-map.png", title="tiny")
        robustness_curves(disturbed, draw / "curves.png", title="tiny")
        sweep_figure([RunCurve(name, places, places, falling, True) for name in some], draw / "sweep.png", title=ALL)
        ablation_figure(rows, draw / "ablation.png")
        convergence_figure({name: run for name in some}, draw / "convergence.png")
        training_curve(read_journal(run / "metrics.jsonl"), draw / "training-curve.png", baselines={"$x^": 0.2})
    assert len(list(draw.iterdir())) == 7


FORMULAS = ["=cmd|'/C calc'!A1", "+1+cmd", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "＝1", "'quoted", "''", "'=x"]


@pytest.mark.parametrize("word", [*FORMULAS, "-0.5", "+3", "-", "nan", "1,000", "DSFFNet", "", "'"])
def test_no_spreadsheet_runs_a_csv_and_it_reads_back_as_it_was(tmp_path: Path, word: str) -> None:
    row = Row(word, "unseen", 0, 1, 2, 3, 4, *([-0.5] * 8))
    write_csv([row], tmp_path / "rows.csv", Row)
    with open(tmp_path / "rows.csv", encoding="utf-8", newline="") as file:
        (cells,) = csv.DictReader(file)
    assert cells["method"].startswith("'") == (word in FORMULAS) or word == "'"
    assert cells["pmd"] == "-0.5", "numbers stay numbers"
    assert read_csv(tmp_path / "rows.csv", Row) == [row]
    assert read_piece(tmp_path / "rows.csv", [(word, "unseen", 0)]) == [row]
    assert inert(-0.5) == -0.5


def test_a_csv_takes_what_no_encoding_has(tmp_path: Path) -> None:
    write_csv([Row(BYTES, "unseen", 0, 1, 2, 3, 4, *([0.5] * 8))], tmp_path / "rows.csv", Row)
    assert read_csv(tmp_path / "rows.csv", Row)[0].method == printable(BYTES)


def test_cells_of_markdown_tables_stay_in_their_cells() -> None:
    lines = [["method", "numbers"], *([name, "**1.5**"] for name in HOSTILE)]
    text = table_markdown(Table(lines))
    assert len(text.splitlines()) == len(lines) + 1
    assert_inert_markdown(text)
    assert all(len(re.findall(r"(?<!\\)\|", line)) == 3 for line in text.splitlines())


def test_a_sweep_of_hostile_descriptions_values_and_reasons(tmp_path: Path) -> None:
    trials = tmp_path / "trials.yaml"
    described = re.sub("[\ud800-\udfff]", "", ALL)[:400]  # a recipe's text is UTF-8, so it holds none of these
    entries = [{"name": "a", "description": described}, {"name": "b", "set": ["training.seed=3"]}]
    trials.write_text(yaml.safe_dump({"recipe": "smoke", "trials": entries}))
    sweep = plan_sweep(recipe=None, shared=[], trials=str(trials))
    begin_record(tmp_path / "trials" / "b", name="b", kind="train", parent=None, parameters={})
    update_record(tmp_path / "trials" / "b", status="FAILED", tags={"failure": f"=HYPERLINK(1) {MARKUP} {TERMINAL}"})
    results = results_of(sweep, tmp_path)
    text = document_markdown(ALL, parts_of(sweep, results, cpus=1))
    assert_inert_markdown(text)
    assert sum(line.startswith("|") for line in text.splitlines()) == 4, "one line a trial, a heading and its rule"
    cells = list(csv.DictReader(table_csv(sweep, results).splitlines(keepends=True)))
    assert next(line for line in cells if line["trial"] == "b")["reason"].startswith("'=HYPERLINK")


def test_mlflow_takes_it_and_shows_it(tmp_path: Path, empty_store: Path) -> None:
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    server = Server(f"sqlite:///{tmp_path / 'mlflow.db'}", artifacts=tmp_path / "mlartifacts")
    run = tmp_path / "run"
    begin_record(run, name=ALL, kind="train", parent=None, parameters={"description": ALL, MARKUP: "1", "../../x": "2"})
    note = {"mlflow.note.content": ALL, SCRIPT: ALL}
    about = {"name": ALL, "url": ALL, "uuid": "0", "manifest_sha256": "0" * 64}
    (run / SCRIPT.replace("/", "-")).write_text("an artifact")
    update_record(
        run,
        tags=note,
        dataset=about,
        metrics={f"pmd/{name}": 1.0 for name in HOSTILE},
        artifacts=[SCRIPT.replace("/", "-")],
    )
    end_record(run, "FINISHED")
    publish(run, server)
    client = mlflow.MlflowClient(server.uri)
    (found,) = client.search_runs([client.get_experiment_by_name(EXPERIMENT).experiment_id])
    assert found.info.run_name == printable(ALL)[:250] and found.data.params["x"] == "2"
    assert found.data.params["description"] == printable_lines(ALL)[:5000]
    assert len([key for key in found.data.metrics if key.startswith("pmd")]) == len(HOSTILE)
    assert found.inputs.dataset_inputs[0].dataset.name == printable(ALL)[:250]
    assert [each.path for each in client.list_artifacts(found.info.run_id)] == [SCRIPT.replace("/", "-")]


def test_a_terminal_obeys_no_name(capsys: pytest.CaptureFixture[str]) -> None:
    """Errors are one line; warnings and facts, such as those of somebody else's dataset, are text."""

    def fail() -> None:
        logging.getLogger("test").warning("of %s", TERMINAL)
        print_facts({"body": TERMINAL, "name": BYTES})
        raise MeshError(f"no mesh {TERMINAL}{REVERSED}{BYTES}")

    with pytest.raises(SystemExit) as ended:
        guarded(fail)
    out, err = capsys.readouterr()
    assert ended.value.code == 1 and not UNPRINTABLE.search(out + err)
    (line,) = [line for line in err.splitlines() if line.startswith("error: ")]
    assert line == f"error: no mesh {printable(TERMINAL + REVERSED + BYTES)}" and len(out.splitlines()) == 2
