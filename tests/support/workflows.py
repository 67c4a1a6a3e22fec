"""What a finished workflow leaves in its folder, made in this process within seconds, without Ray or MLflow."""

import json
import shutil
import time
from pathlib import Path

import numpy as np
import torch
import yaml

from datagen.store import Dataset, open_dataset
from tests.support.recipes import tiny_training
from training.checkpoints.checkpoint import save_checkpoint
from training.engine.trainer import train
from training.evaluation.evaluate import NO_OPS, POSE_TYPES, Row, write_rows
from training.evaluation.tables import report
from training.networks import network_from
from training.reports.plots.training_curve import draw_training_curve
from training.tracking.journal import Journal
from training.tracking.record import begin_record, end_record, update_record


def untrained_run(run: Path) -> Path:
    """A run whose one checkpoint holds a tiny network as training begins with it; as good as any to be read."""
    recipe = tiny_training()
    torch.manual_seed(0)
    about = {"step": 1, "recipe": recipe.model_dump(mode="json"), "dataset": ""}
    save_checkpoint(run, about=about, weights=network_from(recipe.network).state_dict(), state={}, keep=1)
    return run


def rows_on(dataset: Dataset) -> list[Row]:
    """A row for each method and triple of the dataset's lists, its numbers drawn at random."""
    random = np.random.default_rng(0)
    return sorted(
        Row(method, pose_type, number, *map(int, triple), *random.uniform(0.01, 0.02, 8).tolist())
        for pose_type in POSE_TYPES
        for number, triple in enumerate(dataset.evaluation_triples(pose_type))
        for method in ("DSFFNet", *NO_OPS)
    )


def finished_workflow(pristine: Path, out: Path) -> list[Row]:
    """Dataset, run, evaluation (made-up rows, their table, the curve), records and marks in ``out``; its rows."""
    shutil.copytree(pristine, out / "dataset.zarr")
    run, data = out / "run", str(out / "dataset.zarr")
    (out / "recipe.yaml").write_text(yaml.safe_dump({"description": "a tiny one"}))
    begin_record(out, name="tiny", kind="workflow", parent=None, parameters={})
    begin_record(run, name="train", kind="train", parent=out, parameters={})
    train(tiny_training(), data=data, run=run)
    end_record(run, "FINISHED")
    begin_record(run / "evaluation", name="evaluate", kind="evaluate", parent=out, parameters={})
    rows = rows_on(open_dataset(data))
    write_rows(rows, run / "evaluation" / "rows.csv")
    text = report(rows, title="Legs", about=f"On {open_dataset(data).uuid}.", emd_points=16)
    (run / "evaluation" / "tables.md").write_text(text)
    draw_training_curve(run, run / "evaluation" / "figures" / "training-curve.png", baselines={})
    end_record(run / "evaluation", "FINISHED")
    time.sleep(0.002)  # a mark is written after the record's end, which is in milliseconds
    mark = {"fingerprint": "x", "seconds": 61.0}
    (out / "stages").mkdir()
    (out / "stages" / "train.json").write_text(json.dumps(mark))
    update_record(out, status="RUNNING")
    return rows


def recorded_workflow(root: Path) -> Path:
    """A workflow's folder: a parent's record, and that of its training with five rows of a journal and a figure."""
    begin_record(root, name="quick", kind="workflow", parent=None, parameters={"training.batch": "8"})
    begin_record(root / "run", name="train", kind="train", parent=root, parameters={"batch": "8"})
    journal = Journal(root / "run" / "metrics.jsonl")
    for step in range(1, 6):
        journal.write(step, {"loss/total": 1 / step, "learning_rate": 0.1})
    journal.close()
    (root / "run" / "figures").mkdir()
    (root / "run" / "figures" / "curve.png").write_bytes(b"png")
    update_record(root / "run", artifacts=["figures"], metrics={"final": 0.5})
    return root
