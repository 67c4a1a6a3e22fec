"""The registered model: what ``mlflow.pyfunc.load_model`` loads. MLflow runs this file as it is (models from code).

>>> model = mlflow.pyfunc.load_model("models:/dsffnet@latest-trained")              # doctest: +SKIP
>>> model.predict({"source": source_vertices, "target": vertices, "target_faces": faces})     # doctest: +SKIP

The signature takes arrays; with ``model.unwrap_python_model()`` meshes may be named by their files, too:

>>> model.unwrap_python_model().predict(None, {"source": "pose.obj", "target": "person.obj"}, {"align": True})
... # doctest: +SKIP
"""

import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mlflow
import numpy as np
from mlflow.pyfunc import PythonModel

from datagen.common.errors import DsffnetError, MeshError, RecipeError, RegistryError, first_line_of
from datagen.mesh.files import read_mesh_file
from datagen.mesh.geometry import InFaces, Mesh, check_mesh
from training.inference.orientation import Axes, axes_of_both, orientation
from training.inference.transfer import PoseTransfer
from training.tracking.mlflow_store import prepare_store, sqlite_file, sqlite_server

_BAR = "MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR"
_DEFAULTS: dict[str, Any] = {"up": "Y", "front": "", "align": False, "refine": 0.0}


class PoseTransferModel(PythonModel):  # type: ignore[misc]
    """Source vertices [n, 3], target vertices [m, 3] and target faces [f, 3] in; posed vertices [m, 3] out.

    The source may be points. Unwrapped, it takes the source's faces, too (``source_faces``), which the parts network
    makes use of, and the names of files.

    ``params`` are options of ``dsffnet transfer``: ``up`` and ``front`` (of both meshes, or ``source,target``),
    ``align`` (each mesh's axes are found) and ``refine`` (weight of the target's edges; 0, the default, for none).
    """

    _skip_type_hint_validation = True  # the signature validates; MLflow's type hints know no dictionary of arrays

    def load_context(self, context: Any) -> None:
        self._transfer = PoseTransfer.from_run(context.artifacts["weights"])

    def predict(self, context: Any, model_input, params=None):  # type: ignore[no-untyped-def]  # MLflow reads hints
        unknown = sorted(set(params or {}) - set(_DEFAULTS))
        if unknown:
            raise RecipeError(f"{unknown[0]!r} is no option of a transfer; there are {', '.join(_DEFAULTS)}")
        wanted = {**_DEFAULTS, **(params or {})}
        target, source = _mesh(model_input, "target"), _mesh(model_input, "source", points=True)
        of_source, of_target = self._axes(source, target, wanted)
        posed = self._transfer(
            source=source,
            target=target,
            source_axes=of_source,
            target_axes=of_target,
            refine=float(wanted["refine"]),
        )
        return np.asarray(posed.vertices)

    def _axes(self, source: Mesh, target: Mesh, wanted: Mapping[str, Any]) -> tuple[Axes | None, Axes | None]:
        if self._transfer.finds_standing and wanted["up"] == "Y" and wanted["front"] in ("", "Z"):
            return None, None
        if not wanted["align"]:
            return axes_of_both(str(wanted["up"]), str(wanted["front"]))
        return self._found(source, "source"), self._found(target, "target")

    def _found(self, mesh: Mesh, role: str) -> Axes:
        way = orientation(self._transfer.self_errors, [InFaces(mesh).mesh.vertices])
        if not way.is_certain:
            warnings.warn(f"how the {role} stands is not certain: it is taken as it lies", stacklevel=4)
        return way.axes


def _mesh(model_input: Any, role: str, *, points: bool = False) -> Mesh:
    """The mesh of a role; ``points``: no faces are asked of it."""
    given = model_input[role]
    if isinstance(given, str | Path):
        return read_mesh_file(given, points=points).mesh
    if f"{role}_faces" not in model_input and not points:
        raise MeshError(f"{role}_faces is missing: triangles [f, 3] go with the vertices of {role}")
    faces = np.asarray(model_input.get(f"{role}_faces", ()), np.int64)
    faces = faces if faces.size else faces.reshape(0, 3)
    return check_mesh(Mesh(np.asarray(given, np.float64), faces), name=role, points=points)


def download_weights(uri: str, tracking_uri: str, folder: Path, *, own: bool = False) -> Path:
    """Fetch the weights of a registered model (``models:/NAME@ALIAS`` or ``models:/NAME/VERSION``) into a folder.

    ``own``: the store is one that a folder came with, which nobody has named.

    Raises
    ------
    RegistryError
        There is no such model there, it is none of this project's, or the server cannot be reached.
    """
    database = sqlite_file(tracking_uri)
    if database and not database.is_file():  # MLflow would make one, of an empty registry
        raise RegistryError(f"{uri} cannot be had: there is no MLflow store {database}; check --tracking-uri")
    try:
        if database:
            prepare_store(sqlite_server(database, own=own))
        with _server(tracking_uri):
            found = Path(mlflow.artifacts.download_artifacts(uri, dst_path=str(folder)))
    except Exception as error:  # MLflow's stores and clients raise whatever lies below them: HTTP, SQL, cloud storage
        reason = str(error) if isinstance(error, DsffnetError) else first_line_of(error)
        raise RegistryError(f"{uri} cannot be had from MLflow at {tracking_uri}: {reason}") from error
    weights = found / "artifacts" / "weights"
    if not weights.is_dir():
        raise RegistryError(f"{uri} at {tracking_uri} holds no weights of dsffnet; name a model that a training made")
    return weights


@contextmanager
def _server(uri: str) -> Iterator[None]:
    """Ask this server and its registry in the block.

    The arguments of ``download_artifacts`` do not do it: of ``models:/`` the registry is asked that the process has.
    Where the process has named none, none is named afterwards, lest its registry stay behind when it changes servers.
    """
    tracking, registry = mlflow.get_tracking_uri(), mlflow.get_registry_uri()
    named = {name: os.environ.get(name) for name in (_BAR, "MLFLOW_TRACKING_URI", "MLFLOW_REGISTRY_URI")}
    os.environ[_BAR] = "false"  # of a hundred small files
    mlflow.set_tracking_uri(uri)
    mlflow.set_registry_uri(uri)
    try:
        yield
    finally:
        mlflow.set_tracking_uri(tracking)
        mlflow.set_registry_uri("" if registry == tracking else registry)
        for name, value in named.items():  # MLflow sets them for processes that it starts
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


mlflow.models.set_model(PoseTransferModel())
