"""The MLflow mirror of records (see :mod:`training.record`): the one place that talks to MLflow.

``publish`` can be repeated at any time, after any outage or kill: what has been sent is noted in FOLDER/mlflow.json
behind every call, and what is sent twice all the same (the same metric, step and time) MLflow stores once.
"""

import hashlib
import json
import logging
import os
import shlex
import shutil
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from datagen.errors import DsffnetError
from datagen.mesh import write_atomically
from training.journal import journal_from
from training.record import ALIAS, EXPERIMENT, Record, Server, find_records, read_record

os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("MLFLOW_SKIP_PIP_REQUIREMENTS_CHECK", "true")
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")

log = logging.getLogger(__name__)
_PARENT_TAG = "mlflow.parentRunId"
_METRICS_AT_ONCE, _PARAMETERS_AT_ONCE, _LONGEST_PARAMETER = 900, 90, 5000


class TrackingError(DsffnetError):
    """The tracking server cannot be reached, or refuses; nothing is lost, it can be sent later."""


def publish(root: Path, server: Server) -> None:
    """Bring the tracking server up to date with every record below ``root``, parents first.

    Raises
    ------
    TrackingError
        The server cannot be reached or refuses; repeat later.
    """
    import mlflow

    for chatty in ("mlflow", "alembic"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    try:
        mlflow.set_tracking_uri(server.uri)
        client = mlflow.MlflowClient(server.uri)
        for folder in find_records(root):
            record = read_record(folder)
            if record is not None:
                _Publication(client, server, folder, record).run()
    except Exception as error:  # MLflow's stores and clients raise whatever lies below them: HTTP, SQL, cloud storage
        log.debug("publishing %s failed", root, exc_info=True)
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise TrackingError(
            f"MLflow at {server.uri} could not be brought up to date ({reason}). Nothing is lost: "
            f"dsffnet sync {shlex.quote(str(root))} --tracking-uri {shlex.quote(server.uri)} sends what is missing"
        ) from error


class _Publication:
    """What one record still has to send to one server."""

    def __init__(self, client: Any, server: Server, folder: Path, record: Record) -> None:
        self.client, self.server, self.folder, self.record = client, server, folder, record
        self.sent = _read_sent(folder).get(server.uri, {})

    def run(self) -> None:
        if not self._run_exists():
            self.sent = {"run": self._create_run(), "offsets": {}, "artifacts": {}}
            self._note()
        self._send_parameters()
        if self.record.tags != self.sent.get("tags", {}):
            self._send_tags()
        if self.record.dataset:
            self._once("dataset", self._send_dataset)
        self._send_metrics()
        self._send_artifacts()
        if self.record.model and self.record.status == "FINISHED":
            self._once("model", self._register_model)
        if self.record.status != self.sent.get("status"):
            self._send_status()

    def _run_exists(self) -> bool:
        from mlflow.exceptions import MlflowException

        if "run" not in self.sent:
            return False
        try:
            return bool(self.client.get_run(self.sent["run"]).info.lifecycle_stage == "active")
        except MlflowException as error:
            if error.error_code == "RESOURCE_DOES_NOT_EXIST":
                return False
            raise

    def _create_run(self) -> str:
        tags = {"kind": self.record.kind}
        if self.record.parent:
            parent = (self.folder / self.record.parent).resolve()
            known = _read_sent(parent).get(self.server.uri)
            if known:  # a run that was copied away from its workflow stands alone
                tags[_PARENT_TAG] = known["run"]
        run = self.client.create_run(
            _experiment(self.client, self.server), start_time=self.record.started, run_name=self.record.name, tags=tags
        )
        return str(run.info.run_id)

    def _send_parameters(self) -> None:
        """Parameters once; MLflow lets none change, so what a resumed run has otherwise becomes a tag."""
        from mlflow.entities import Param, RunTag

        given = {key: value[:_LONGEST_PARAMETER] for key, value in self.record.parameters.items()}
        sent = self.sent.get("parameters", {})
        new = [Param(key, value) for key, value in given.items() if key not in sent]
        for start in range(0, len(new), _PARAMETERS_AT_ONCE):
            self.client.log_batch(self.sent["run"], params=new[start : start + _PARAMETERS_AT_ONCE])
        tags = [RunTag(f"changed.{key}", value) for key, value in given.items() if sent.get(key, value) != value]
        if tags:
            self.client.log_batch(self.sent["run"], tags=tags)
        if new or tags:
            self._note(parameters=sent | given)

    def _send_tags(self) -> None:
        from mlflow.entities import RunTag

        tags = [RunTag(key, value[:_LONGEST_PARAMETER]) for key, value in self.record.tags.items()]
        self.client.log_batch(self.sent["run"], tags=tags)
        self._note(tags=self.record.tags)

    def _send_dataset(self) -> None:
        from mlflow.data.code_dataset_source import CodeDatasetSource
        from mlflow.data.meta_dataset import MetaDataset
        from mlflow.entities import DatasetInput, InputTag

        about = self.record.dataset or {}
        dataset = MetaDataset(CodeDatasetSource(tags=about), name=about["name"], digest=about["manifest_sha256"][:36])
        context = InputTag("mlflow.data.context", self.record.kind)
        self.client.log_inputs(self.sent["run"], [DatasetInput(dataset._to_mlflow_entity(), [context])])

    def _send_metrics(self) -> None:
        from mlflow.entities import Metric

        for path in sorted(self.folder.glob("*.jsonl")):
            batch: list[Any] = []
            offset = self.sent["offsets"].get(path.name, 0)
            for behind, row in journal_from(path, offset):
                moment, step = int(row.pop("time") * 1000), row.pop("step")
                batch += [Metric(key, float(value), moment, step) for key, value in row.items()]
                if len(batch) >= _METRICS_AT_ONCE:
                    self._send_batch(batch, path.name, behind)
                    batch = []
                offset = behind
            if batch:
                self._send_batch(batch, path.name, offset)
        if self.record.metrics != self.sent.get("metrics", {}):
            moment = self.record.ended or int(time.time() * 1000)
            batch = [Metric(key, value, moment, 0) for key, value in self.record.metrics.items()]
            self.client.log_batch(self.sent["run"], metrics=batch)
            self._note(metrics=self.record.metrics)

    def _send_batch(self, batch: list[Any], name: str, offset: int) -> None:
        self.client.log_batch(self.sent["run"], metrics=batch)
        self.sent["offsets"][name] = offset
        self._note()

    def _send_artifacts(self) -> None:
        for relative in self.record.artifacts:
            root = self.folder / relative
            for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
                if path.is_file() and not path.name.startswith("."):
                    self._send_artifact(path)

    def _send_artifact(self, path: Path) -> None:
        name = os.path.relpath(path, self.folder)
        stamp = f"{path.stat().st_mtime_ns} {path.stat().st_size}"
        if self.sent["artifacts"].get(name) == stamp:
            return
        folder = "" if name.startswith("..") else os.path.dirname(name)
        self.client.log_artifact(self.sent["run"], str(path), folder or None)
        self.sent["artifacts"][name] = stamp
        self._note()

    def _register_model(self) -> None:
        import mlflow

        from training.checkpoint import export_weights, require_checkpoint

        assert self.record.model is not None
        checkpoint = require_checkpoint(self.folder)
        packages = [Path(__file__).parent, Path(__file__).parents[1] / "datagen"]
        with tempfile.TemporaryDirectory() as temporary, _quiet_run(self.sent["run"]):
            export_weights(checkpoint, Path(temporary) / "weights")
            code = [str(shutil.copytree(p, Path(temporary) / p.name, ignore=_NO_CACHES)) for p in packages]
            model = mlflow.pyfunc.log_model(
                name="model",
                python_model=str(Path(__file__).parent / "mlflow_model.py"),
                artifacts={"weights": str(Path(temporary) / "weights")},
                code_paths=code,
                signature=_signature(),
                pip_requirements=["torch", "safetensors", "numpy", "scipy", "pydantic", "filelock", "zarr", "trimesh"],
            )
        name, version = self.record.model, self._register_version(model.model_uri, model.model_id)
        self.client.set_registered_model_alias(name, ALIAS, version)

    def _register_version(self, source: str, model: str) -> str:
        """As log_model's own registration, which prints into the progress bars."""
        from mlflow.exceptions import MlflowException

        try:
            self.client.create_registered_model(self.record.model)
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":
                raise
        version = self.client.create_model_version(self.record.model, source, self.sent["run"], model_id=model)
        return str(version.version)

    def _send_status(self) -> None:
        if self.record.status == "RUNNING":
            self.client.update_run(self.sent["run"], status="RUNNING")
        else:
            self.client.set_terminated(self.sent["run"], self.record.status, self.record.ended)
        self._note(status=self.record.status)

    def _once(self, key: str, send: Any) -> None:
        digest = hashlib.sha256(json.dumps(self.record.dataset).encode()).hexdigest()
        value = digest if key != "model" else self.record.model_version
        if self.sent.get(key) != value:
            send()
            self._note(**{key: value})

    def _note(self, **changes: Any) -> None:
        self.sent |= changes
        state = _read_sent(self.folder) | {self.server.uri: self.sent}
        write_atomically(self.folder / "mlflow.json", json.dumps(state, indent=1).encode())


@contextmanager
def _quiet_run(run: str) -> Iterator[None]:
    """The fluent API's run, without its advice on type hints and input examples (there is a signature)."""
    import mlflow

    with warnings.catch_warnings(), mlflow.start_run(run_id=run):
        warnings.simplefilter("ignore")
        yield


_NO_CACHES = shutil.ignore_patterns("__pycache__", "*.pyc", "node_modules")


def _read_sent(folder: Path) -> dict[str, Any]:
    path = folder / "mlflow.json"
    return dict(json.loads(path.read_text())) if path.exists() else {}


def _experiment(client: Any, server: Server) -> str:
    found = client.get_experiment_by_name(EXPERIMENT)
    if found is not None:
        return str(found.experiment_id)
    return str(client.create_experiment(EXPERIMENT, server.artifacts.as_uri() if server.artifacts else None))


def _signature() -> Any:
    import numpy as np
    from mlflow.models import ModelSignature
    from mlflow.types import Schema, TensorSpec

    real, whole = np.dtype(np.float64), np.dtype(np.int64)
    names = {"source": real, "target": real, "target_faces": whole}
    inputs = Schema([TensorSpec(kind, (-1, 3), name) for name, kind in names.items()])
    return ModelSignature(inputs=inputs, outputs=Schema([TensorSpec(real, (-1, 3), "vertices")]))


class Mirror:
    """Publishes in the background while a workflow runs; an outage is said once, and made up for later."""

    def __init__(self, root: Path, server: Server, *, every: float = 5.0) -> None:
        self._root, self._server, self._every = root, server, every
        self._stop = threading.Event()
        self._failed: TrackingError | None = None
        self._thread = threading.Thread(target=self._follow, name="mlflow-mirror", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> TrackingError | None:
        """Stop, publish once more, and return what went wrong if that did not work."""
        self._stop.set()
        self._thread.join()
        self._publish()
        return self._failed

    def _follow(self) -> None:
        pause = 0.1
        while not self._stop.wait(pause):
            self._publish()
            pause = self._every if self._failed is None else max(30.0, self._every)

    def _publish(self) -> None:
        try:
            publish(self._root, self._server)
            self._failed = None
        except TrackingError as error:
            if self._failed is None:
                log.warning("%s", error)
            self._failed = error
