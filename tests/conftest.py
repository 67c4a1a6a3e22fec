"""Shared fixtures: a tiny dataset of the procedural leg, made once a session and copied where a test spoils it."""

import shutil
from pathlib import Path

import pytest

from datagen.generate import generate
from tests.support.recipes import tiny_dataset


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
