"""Comparisons from start to end, on legs: trained, measured on the same triples, shown; then nothing is left to do."""

import io
import os
import re
import shutil
import subprocess
import sys
from contextlib import nullcontext, redirect_stdout
from pathlib import Path

import mlflow
import pytest

from datagen.common.errors import RecipeError
from datagen.generate import inline
from tests.support.trials import here
from training.evaluation.evaluate import read_rows
from training.tracking.record import read_record
from workflows.cli.main import parsed
from workflows.studies.comparison import run as comparing
from workflows.studies.comparison.plan import plan_comparison

ROOT = Path(__file__).parents[4]
LEGS = """
description: legs
recipe: smoke
set: [data.identities.training=3, data.identities.evaluation=2, data.poses.seen=6, data.poses.unseen=4,
      data.triples.count=5, training.steps=6, training.evaluate_every=3, training.batch=2, training.log_every=1,
      evaluation.emd_points=16, evaluation.examples=1]
methods:
"""
THREE = """\
  - {name: DSFFNet, description: ours}
  - {name: NPT, set: [training.network.name=npt, "training.network.encoder_widths=[8,8,13]"]}
  - name: 3D-CoreNet
    set: [training.network.name=corenet3d, "training.network.feature_widths=[8,8,16]",
          "training.network.generator_widths=[16,16,8]", training.augmentation.shuffle=true]
"""
FOUR = """\
  - {name: DSFFNet}
  - {name: w/o FFAdaIN, set: [training.network.feature_fusion=false]}
  - {name: w/o side target, set: [training.network.target_side=false]}
  - {name: w/o L_edge, set: [training.edge_weight=0]}
"""


def command(name: str, out: Path, methods: str) -> list[str]:
    recipe = out.parent / f"{name}.yaml"
    recipe.write_text(LEGS + methods)
    return [name, "--recipe", str(recipe), "--out", str(out)]


def run(name: str, out: Path, methods: str, store: Path | None = None) -> str:
    """What the command prints; its tasks run in this process, and MLflow's store is a copy of an empty one."""
    if store:
        out.mkdir()
        shutil.copy(store, out / "mlflow.db")
    with pytest.MonkeyPatch.context() as patched, redirect_stdout(io.StringIO()) as said:
        patched.setattr("workflows.studies.sweep.run.ray_cluster", nullcontext)
        patched.setattr("workflows.studies.comparison.run.ray_trials", here)
        patched.setattr("workflows.studies.comparison.evaluate.ray_runner", inline)
        options = parsed(command(name, out, methods))
        options.command(options)
    return said.getvalue()


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory, empty_store: Path) -> tuple[Path, str]:
    out = tmp_path_factory.mktemp("runs") / "compare"
    return out, run("compare", out, THREE, empty_store)


def test_every_method_and_no_op_is_measured_on_the_same_triples(compared: tuple[Path, str]) -> None:
    out, _ = compared
    rows = read_rows(out / "evaluation" / "rows.csv")
    methods = ["DSFFNet", "NPT", "3D-CoreNet", "target unchanged", "source unchanged"]
    assert {row.method for row in rows} == set(methods)
    asked = {
        name: sorted(
            (r.pose_type, r.triple, r.source_identity, r.source_pose, r.target_identity, r.target_pose)
            for r in rows
            if r.method == name
        )
        for name in methods
    }
    assert len(asked["NPT"]) == 10 and all(triples == asked["NPT"] for triples in asked.values())


def test_tables_figures_viewer_and_report_are_there_and_say_the_same(compared: tuple[Path, str]) -> None:
    out, said = compared
    table = (out / "evaluation" / "tables.md").read_text()
    assert table in said and all(f"Table {number}" in table for number in (1, 2))
    report = (out / "report.md").read_text()
    pmd = {row.method: row.pmd for row in read_rows(out / "evaluation" / "rows.csv")}
    assert set(pmd) >= {"DSFFNet", "NPT", "3D-CoreNet"}
    for name in ("DSFFNet", "NPT", "3D-CoreNet"):
        assert name in report and name in table
    assert "2.39" in table, "the paper's own numbers stand beside ours"
    for name in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", report):
        assert (out / name).stat().st_size > 1000, name
    page = (out / "report.html").read_text()
    assert page.count("<img") == page.count('src="data:image/png;base64,') >= 2
    assert (out / "evaluation" / "viewer.html").stat().st_size > 10_000


def test_mlflow_shows_a_parent_its_trainings_and_the_evaluation(compared: tuple[Path, str]) -> None:
    out, _ = compared
    client = mlflow.MlflowClient(f"sqlite:///{out / 'mlflow.db'}")
    runs = client.search_runs([client.get_experiment_by_name("dsffnet").experiment_id])
    names = {run.info.run_name: run for run in runs}
    parent = names["Comparison of methods: compare"]
    children = {name for name, r in names.items() if r.data.tags.get("mlflow.parentRunId") == parent.info.run_id}
    assert children == {"generate", "DSFFNet", "NPT", "3D-CoreNet", "evaluate"}
    assert {"report.html", "report.md"} <= {item.path for item in client.list_artifacts(parent.info.run_id)}
    assert any("pmd" in metric for metric in parent.data.metrics)


def test_the_same_command_again_has_nothing_to_do(compared: tuple[Path, str]) -> None:
    out, _ = compared
    before = {path: path.stat().st_mtime_ns for path in (out / "evaluation").rglob("*") if path.is_file()}
    said = run("compare", out, THREE)
    assert "trials: 3 of 3 skipped" in said and "evaluate: skipped" in said
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_an_ablation_leaves_the_folder_of_a_comparison_alone(compared: tuple[Path, str]) -> None:
    out, _ = compared
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file() and path.name != ".lock"}
    plan = plan_comparison(str(out.parent / "compare.yaml"), kind="ablation")
    with pytest.raises(RecipeError, match=r"another kind of work: comparison .*--out"):
        comparing.run_comparison(plan, out)
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_no_report_of_an_earlier_evaluation_outlives_the_start_of_a_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut_short(*_: object) -> None:
        raise KeyboardInterrupt

    for name in comparing.REPORTS:
        (tmp_path / name).write_text("of an earlier evaluation")
    monkeypatch.setattr(comparing, "evaluate_methods", cut_short)
    monkeypatch.setattr(comparing, "open_dataset", lambda url: None)
    plan = plan_comparison("small", kind="comparison")
    with pytest.raises(KeyboardInterrupt):
        comparing._evaluate(plan, comparing.folder_of(plan, tmp_path), {})
    assert not any((tmp_path / name).exists() for name in comparing.REPORTS)


def test_an_ablation_trains_four_and_gives_table_three(tmp_path: Path, empty_store: Path) -> None:
    said = run("ablation", tmp_path / "ablation", FOUR, empty_store)
    assert "Table 3" in said and all(name in said for name in ("w/o FFAdaIN", "w/o side target", "w/o L_edge"))
    assert (tmp_path / "ablation" / "evaluation" / "figures" / "ablation.png").stat().st_size > 5000
    record = read_record(tmp_path / "ablation")
    assert record is not None and record.kind == "ablation" and record.status == "FINISHED"


@pytest.mark.cluster
@pytest.mark.timeout(600)
def test_on_real_ray(tmp_path: Path) -> None:
    own = {name: value for name, value in os.environ.items() if name != "MLFLOW_TRACKING_URI"}
    words = [sys.executable, "-m", "workflows", *command("compare", tmp_path / "out", THREE)]
    done = subprocess.run(words, cwd=ROOT, env=own, capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 0 and "Table 2" in done.stdout, done.stderr[-3000:]
