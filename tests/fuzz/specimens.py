"""Real files of every kind that is read, small, made once: what a case damages a copy of."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from datagen.generate import generate
from datagen.mesh.files import read_mesh_file, save_mesh, write_posed
from datagen.mesh.formats import FORMATS
from datagen.mesh.geometry import Mesh
from datagen.poses import PARENTS, Poses
from datagen.poses.pose_files import write_pose_file
from datagen.poses.skeletons import JOINTS
from datagen.store import open_dataset
from tests.support.recipes import tiny_dataset, tiny_training
from tests.support.shapes.mesh_files import GOLDEN, golden
from tests.support.shapes.models import random_model, save_npz, save_pickle
from tests.support.shapes.rigged_files import Rig, about


class Specimens:
    """Folders of real files by name, each made when it is first asked for."""

    def __init__(self, home: Path, *, dataset: Path | None = None) -> None:
        """``dataset``: a tiny dataset of the leg that is there already."""
        self._home, self._dataset = home, dataset

    def folder(self, name: str) -> Path:
        """The folder that holds ``leg.zarr``, ``run``, ``workflow`` and so on; not to be changed."""
        folder = self._home / name
        if not folder.exists():
            making = self._home / f".{name}"
            shutil.rmtree(making, ignore_errors=True)
            making.mkdir(parents=True)
            _MAKERS[name](making, self)
            making.rename(folder)
        return folder

    @property
    def dataset(self) -> Path:
        """The tiny dataset."""
        return self.folder("dataset") / "leg.zarr"


def _make_dataset(folder: Path, specimens: Specimens) -> None:
    if specimens._dataset is not None:
        shutil.copytree(specimens._dataset, folder / "leg.zarr")
    else:
        generate(tiny_dataset(), str(folder / "leg.zarr"))
        (folder / "leg.zarr.lock").unlink(missing_ok=True)


def _make_run(folder: Path, specimens: Specimens) -> None:
    """A run of four steps with two checkpoints, its record and its origin; half of it; two meshes to transfer with."""
    from training.engine.trainer import train
    from training.tracking.record import begin_record, end_record
    from workflows.pipeline.train import write_head

    recipe = tiny_training(steps=4, checkpoint_every=2, evaluate_every=2, average=0.9)
    run, dataset = folder / "run", open_dataset(str(specimens.dataset))
    begin_record(run, name="train", kind="train", parent=None, parameters={"training.batch": "4"})
    write_head(recipe, dataset, run)
    origin = json.loads((run / "provenance.json").read_text())
    origin["dataset"]["url"] = "leg.zarr"
    (run / "provenance.json").write_text(json.dumps(origin))
    train(recipe, data=str(specimens.dataset), run=run)
    end_record(run, "FINISHED")
    shutil.copytree(run, folder / "half")
    shutil.rmtree(folder / "half" / "checkpoints" / "step-00000004")
    for name in ("latest", "best"):
        (folder / "half" / name).write_text("step-00000002\n")
    save_mesh(Mesh(dataset.vertices(3, 7), dataset.faces(3)), folder / "pose.obj")
    save_mesh(Mesh(dataset.vertices(4, 0), dataset.faces(4)), folder / "person.obj")


def _make_weights(folder: Path, specimens: Specimens) -> None:
    """Exported weights with their manifest, the same without one, and a state_dict as the authors publish theirs."""
    import torch

    from tests.support.three_networks import to_released
    from training.checkpoints.checkpoint import export_weights, require_checkpoint
    from training.networks.npt import NPT

    export_weights(require_checkpoint(specimens.folder("run") / "run"), folder / "weights")
    (folder / "weights" / "more").mkdir()
    shutil.copy(folder / "weights" / "weights.safetensors", folder / "weights" / "more" / "alone.safetensors")
    torch.manual_seed(0)
    torch.save(to_released(NPT(encoder_widths=(8, 16, 32))), folder / "weights" / "npt.pth")


def _make_workflow(folder: Path, specimens: Specimens) -> None:
    """A workflow's folder: records, marks of its stages, what was sent to MLflow, journals, rows, a figure."""
    from tests.support.workflows import recorded_workflow
    from training.evaluation.results import Row, write_rows
    from training.tracking.mirror_state import note_sent
    from training.tracking.record import end_record, update_record

    root = recorded_workflow(folder / "workflow")
    write_rows([Row("DSFFNet", "seen", 3, 1, 2, 3, 4, *[0.5] * 8)] * 3, root / "run" / "rows.csv")
    about_data = {"name": "leg.zarr", "url": "leg.zarr", "manifest_sha256": "0" * 64}
    update_record(root / "run", artifacts=["figures", "rows.csv"], metrics={"final": 0.5}, dataset=about_data)
    end_record(root / "run", "FINISHED")
    first = (root / "run" / "metrics.jsonl").read_bytes().index(b"\n") + 1
    sent = {"run": "0" * 32, "offsets": {"metrics.jsonl": first}, "artifacts": {}}
    note_sent(root / "run", "sqlite:///mlflow.db", sent)
    (root / "stages").mkdir()
    (root / "stages" / "generate.json").write_text(json.dumps({"fingerprint": "0" * 64, "seconds": 1.5}))


def _make_recipe(folder: Path, specimens: Specimens) -> None:
    import yaml

    from workflows.recipe.loader import load_recipe

    for name in ("quickstart", "smoke", "smpl-paper"):
        recipe = load_recipe(name).model_dump(mode="json")
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(recipe, sort_keys=False))


def _make_mesh(folder: Path, specimens: Specimens) -> None:
    """Each format with all that it can hold, in a folder of its own with the files that belong to it."""
    rich = read_mesh_file(golden("cube.obj", folder / "obj").rename(folder / "obj" / "mesh.obj"))
    for suffix in ("ply", "glb", "off", "stl"):
        write_posed(rich, rich.mesh.vertices, folder / suffix / f"mesh.{suffix}")
    (folder / "obj" / "mesh.obj").write_bytes((GOLDEN / "cube.obj").read_bytes() + b"f 1 2 3 \\\n4\n")
    golden("rich.ply", folder / "ply text").rename(folder / "ply text" / "mesh.ply")
    (folder / "stl text").mkdir()
    trimesh.creation.box().export(folder / "stl text" / "mesh.stl", file_type="stl_ascii")


def _make_plain(folder: Path, specimens: Specimens) -> None:
    """Vertices and faces alone, as data sets have them."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    for suffix in FORMATS:
        save_mesh(Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])), folder / f"mesh{suffix}")


def _make_character(folder: Path, specimens: Specimens) -> None:
    rig = Rig()
    turns = [about("x", angle) for angle in (0, 20, 0)]
    rig.clips = {"walk": {"Leg.L": rig.keys("Leg.L", turns, [0.0, 0.5, 1.0])}}
    for name in ("rig.glb", "rig.gltf"):
        (folder / name.replace(".", " ")).mkdir()
        rig.document().save(folder / name.replace(".", " ") / name)


def _make_poses(folder: Path, specimens: Specimens) -> None:
    rotations = np.random.default_rng(0).normal(0, 0.3, (6, len(JOINTS), 3))
    write_pose_file(folder / "poses.npz", Poses(tuple(JOINTS), tuple(PARENTS), rotations))
    np.savez(folder / "motion.npz", poses=np.zeros((40, 66)), trans=np.zeros((40, 3)), gender=np.array("male"))


def _make_model(folder: Path, specimens: Specimens) -> None:
    arrays = random_model(tuple(PARENTS), vertices=40, betas=4)
    save_npz(folder / "model.npz", arrays)
    save_pickle(folder / "model.pkl", arrays)


def _make_server(folder: Path, specimens: Specimens) -> None:
    """An MLflow store with its tables, which take seconds to make."""
    import mlflow

    mlflow.MlflowClient(f"sqlite:///{folder / 'mlflow.db'}").search_experiments()


_MAKERS: dict[str, Callable[[Path, Specimens], None]] = {
    "dataset": _make_dataset, "run": _make_run, "weights": _make_weights, "workflow": _make_workflow,
    "recipe": _make_recipe, "mesh": _make_mesh, "plain": _make_plain, "character": _make_character,
    "poses": _make_poses, "model": _make_model, "server": _make_server,
}  # fmt: skip
