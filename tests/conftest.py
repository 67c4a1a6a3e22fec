"""Shared fixtures: a tiny dataset of the procedural leg, made once a session and copied where a test spoils it."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the workers fill the CPUs; their threads would wait for each other

import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from datagen.generate import generate
from tests.support.recipes import tiny_dataset

hypothesis.settings.register_profile("busy", deadline=None)  # a machine that others use has slow moments
hypothesis.settings.load_profile("busy")
_MLFLOW = ("MLFLOW_TRACKING_URI", "MLFLOW_REGISTRY_URI")


@pytest.fixture(scope="session", autouse=True)
def _signals_are_heeded() -> Iterator[None]:
    """A suite that was started in the background has Ctrl-C (under nohup: SIGHUP) ignored, as have its children."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session", autouse=True)
def _no_mlflow_of_the_developer() -> Iterator[None]:
    """Nothing of the suite may find, or write into, the MLflow server of whoever runs it."""
    with pytest.MonkeyPatch.context() as patched:
        for name in _MLFLOW:
            patched.delenv(name, raising=False)
        yield


@pytest.fixture(autouse=True)
def _mlflow_as_it_was() -> Iterator[None]:
    """``mlflow.set_tracking_uri`` writes into the process's environment; the next test must not see it."""
    before = {name: os.environ.get(name) for name in _MLFLOW}
    yield
    if before != {name: os.environ.get(name) for name in _MLFLOW}:
        import mlflow

        mlflow.set_tracking_uri(before["MLFLOW_TRACKING_URI"])
        mlflow.set_registry_uri(before["MLFLOW_REGISTRY_URI"])
        os.environ.pop("MLFLOW_REGISTRY_URI", None)  # which it leaves
        os.environ.update({name: uri for name, uri in before.items() if uri is not None})


@pytest.fixture(scope="session")
def _pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pristine") / "leg.zarr"
    generate(tiny_dataset(), str(path))
    return path


@pytest.fixture
def dataset(_pristine: Path) -> str:
    """URL of a small complete dataset; read only."""
    return str(_pristine)


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An MLflow database with its tables, which take seconds to make."""
    import mlflow

    path = tmp_path_factory.mktemp("mlflow") / "mlflow.db"
    mlflow.MlflowClient(f"sqlite:///{path}").search_experiments()
    return path


@pytest.fixture
def spoilable(_pristine: Path, tmp_path: Path) -> Path:
    """A copy of the small dataset that a test may damage."""
    return Path(shutil.copytree(_pristine, tmp_path / "leg.zarr"))
