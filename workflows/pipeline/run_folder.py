"""Every name in the folders of a workflow, of a run and of an evaluation: where it is, and what ``--fresh`` removes.

To add a file: one line here. The test of a finished workflow fails for a file that no line owns.
"""

import os
import shlex
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

from filelock import Timeout

from datagen.common.errors import RecipeError, WorkflowError
from datagen.common.files import lock_within
from training.tracking.record import read_record

Value = TypeVar("Value")


class _Entry(Generic[Value]):
    """An entry of a folder, which thereby owns it: its path, or the folder that it is; ``kept`` when all is removed."""

    def __init__(self, name: str, made: Callable[[Path], Value], *, kept: bool = False) -> None:
        self._name, self._made, self._kept = name, made, kept

    def __set_name__(self, folder: "type[_Folder]", _: str) -> None:
        folder.names = (*folder.names, self._name)
        if self._kept:
            folder.kept = (*folder.kept, self._name)

    def __get__(self, folder: "_Folder", _: object) -> Value:
        return self._made(folder.path / self._name)


def _file(name: str, *, kept: bool = False) -> _Entry[Path]:
    return _Entry(name, Path, kept=kept)


class _Folder:
    """A folder that we write: ``names`` of its entries (with wildcards), and those ``kept`` when all is removed.

    ``kind``: of the work that has its record in it.
    """

    kind: ClassVar[str]
    names: ClassVar[tuple[str, ...]] = ("*.unreadable",)
    kept: ClassVar[tuple[str, ...]] = ()
    record = _file("record.json")
    mirror_note = _file("mlflow.json")
    mirror_lock = _file(".mlflow.lock")
    load = _file("system.jsonl")
    lock = _file(".lock", kept=True)

    def __init__(self, path: Path) -> None:
        self.path = path

    def owned(self) -> list[Path]:
        """The entries that are there and belong to the folder; what tells whose it is comes last."""
        found = [path for path in self._entries() if _matches(path, self.names)]
        return sorted(found, key=lambda path: path.name in ("record.json", "recipe.yaml"))

    def strangers(self) -> list[Path]:
        """The entries that are there and do not."""
        return [path for path in self._entries() if not _matches(path, self.names)]

    def remove(self) -> None:
        """Remove what belongs to the folder, but for what is kept; of a link, only the link."""
        for path in self.owned():
            if _matches(path, self.kept):
                continue
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()

    def require_kind(self) -> None:
        """Refuse a folder whose record, of another kind of work, would be replaced, and see :func:`require_place`.

        Raises
        ------
        RecipeError
            It is one.
        """
        require_place(self.path)
        record = read_record(self.path)
        if record and record.kind != self.kind:
            raise RecipeError(
                f"{self.path} is the folder of another kind of work: {record.kind} {record.name!r}. "
                "Choose another --out"
            )

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Hold the folder, which is made, while the block runs; the operating system frees it if this process dies.

        Raises
        ------
        RecipeError
            See :meth:`require_kind`.
        WorkflowError
            Another process holds it, or it is a link to what is not there.
        """
        self.require_kind()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise WorkflowError(
                f"{self.path} leads to {os.path.realpath(self.path)}, which is not there. Mount or make it, "
                "or choose another --out"
            ) from error
        try:
            with lock_within(self.path, self.lock.name).acquire(timeout=0):
                yield
        except Timeout as error:
            raise WorkflowError(
                f"another command is at work in {self.path}. Wait for it, or stop it, then run again"
            ) from error

    def _entries(self) -> list[Path]:
        return sorted(self.path.iterdir()) if self.path.is_dir() else []


class EvaluationFolder(_Folder):
    """HOME/evaluation[-DATASET][-LABEL], or OUT/evaluation of a comparison."""

    kind = "evaluate"
    rows = _file("rows.csv")
    tables = _file("tables.md")
    viewer = _file("viewer.html")
    inference = _file("inference.json")
    figures = _file("figures")
    examples = _file("figures/examples.png")
    curve = _file("figures/training-curve.png")
    meshes = _file("meshes")
    measured = _file("measured")
    chunks = _file("chunks")
    robustness = _file("robustness")
    generalisation = _file("generalisation")


class RunFolder(_Folder):
    """The folder of one training."""

    kind = "train"
    names = (*_Folder.names, "evaluation-*")
    recipe = _file("recipe.yaml")
    provenance = _file("provenance.json")
    journal = _file("metrics.jsonl")
    checkpoints = _file("checkpoints")
    latest = _file("latest")
    best = _file("best")
    figures = _file("figures")
    curve = _file("figures/training-curve.png")
    coefficients = _file("figures/adaptive-coefficients.png")
    pictures = _file("pictures")
    input = _file("input.json")
    stop = _file("stop")
    failure = _file("failure.json")
    traceback = _file("failure.txt")
    not_finite = _file("not-finite.json")
    launch_mark = _file(".launch")
    room = _file(".room")
    ray = _file("ray")
    evaluation = _Entry("evaluation", EvaluationFolder)
    lock = _file(".driver.lock", kept=True)

    def remove(self) -> None:
        """Remove what a training keeps in its folder.

        Raises
        ------
        RecipeError
            The folder is not a training run's.
        """
        if any(not _matches(path, self.kept) for path in self._entries()) and not self._is_training():
            raise RecipeError(
                f"{self.path} is not the folder of a training, so --fresh leaves it alone. Choose another --out"
            )
        super().remove()

    def require_kind(self) -> None:
        """Refuse, beside what :meth:`_Folder.require_kind` does, files of others that a training would replace."""
        super().require_kind()
        if not self._is_training() and not (self.journal.is_file() and self.provenance.is_file()):
            replaced = [path.name for path in self.owned() if not _matches(path, self.kept)]
            if replaced and not (self.path / self.record.name).exists():
                raise RecipeError(
                    f"{self.path} is not the folder of a training, and holds {replaced[0]}, which one would replace. "
                    "Choose another --out"
                )

    def _is_training(self) -> bool:
        """By its record, or, where torchrun trained without a workflow, by what every training writes."""
        record = read_record(self.path)
        return record.kind == "train" if record else self.checkpoints.is_dir() and self.journal.is_file()


class WorkflowFolder(_Folder):
    """The folder of a workflow, or of another ``kind`` of work that makes a dataset and trains on it."""

    kind = "workflow"
    names = (*_Folder.names, "mlflow.db*")
    kept = (*_Folder.kept, "mlflow.db*")
    recipe = _file("recipe.yaml")
    dataset = _file("dataset.zarr", kept=True)
    dataset_lock = _file("dataset.zarr.lock", kept=True)
    generate = _file("generate")
    stages = _file("stages")
    report = _file("report.md")
    page = _file("report.html")
    artifacts = _file("mlartifacts", kept=True)

    @property
    def data(self) -> str:
        """The URL of the dataset."""
        return str(self.dataset)

    def remove(self) -> None:
        """Remove what the work keeps in the folder, its dataset too; the MLflow store stays.

        Raises
        ------
        RecipeError
            The folder does not look like one of this kind.
        """
        from datagen.store.location import remove

        self.require_kind()
        if not self._is_ours():
            raise RecipeError(
                f"{self.path} holds files, but no {self.kind} of ours, so --fresh leaves it alone. Choose another --out"
            )
        if self.dataset.is_symlink():
            raise RecipeError(
                f"{self.dataset} is a link, and --fresh removes nothing elsewhere. Remove the dataset itself: "
                f"rm -r {shlex.quote(os.path.realpath(self.dataset))}; or the link"
            )
        remove(self.data)
        super().remove()

    def _is_ours(self) -> bool:
        return self.recipe.exists() or not self.strangers()


class SingleRunFolder(WorkflowFolder):
    """The folder of ``workflows/full.py``: a dataset, one training on it, and perhaps another ``beside`` it."""

    run = _Entry("run", RunFolder)
    beside = _Entry("beside", RunFolder)


class AvatarFolder(WorkflowFolder):
    """The folder of ``dsffnet avatar``: scans, what is made of each outfit, its template's training, and the avatar."""

    kind = "avatar"
    outfits = _file("outfits")
    templates = _file("templates")
    run = _Entry("run", RunFolder)
    evaluation = _Entry("evaluation", EvaluationFolder)

    def template(self, outfit: str) -> RunFolder:
        """The training of an outfit's template."""
        return RunFolder(self.templates / outfit)


class TrialsFolder(WorkflowFolder):
    """A folder of many trainings on one dataset."""

    trials = _file("trials")
    plan = _file("trials.yaml")
    mark = _file(".sweep")

    def _is_ours(self) -> bool:
        return read_record(self.path) is not None or (not self.trials.exists() and super()._is_ours())


class SweepFolder(TrialsFolder):
    """The folder of a sweep."""

    kind = "sweep"
    table = _file("sweep.md")
    csv = _file("sweep.csv")
    figures = _file("figures")
    best = _file("best.yaml")


class ComparisonFolder(TrialsFolder):
    """The folder of a comparison of methods."""

    kind = "comparison"
    evaluation = _Entry("evaluation", EvaluationFolder)


class AblationFolder(ComparisonFolder):
    """The folder of the ablations."""

    kind = "ablation"


def workflow_kinds() -> set[str]:
    """The kinds of work that have a folder, with an MLflow store, for all that they make."""
    found = [WorkflowFolder]
    for each in found:
        found.extend(each.__subclasses__())
    return {each.kind for each in found}


def require_place(path: Path) -> None:
    """Refuse what is a file or a dataset, or lies in one: no folder of work can be made there.

    Raises
    ------
    RecipeError
        It does.
    """
    place = Path(os.path.realpath(path))
    for each in (place, *place.parents):
        if (is_file := each.exists() and not each.is_dir()) or (each / "grid" / "zarr.json").is_file():
            what = "file" if is_file else "dataset"
            raise RecipeError(f"{path} is the {what} {each}, or lies in it. Choose another --out, a folder of its own")


def _matches(path: Path, names: tuple[str, ...]) -> bool:
    return any(fnmatchcase(path.name, name) for name in names)
