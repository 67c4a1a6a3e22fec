"""The MLflow mirror of records (see :mod:`training.tracking.record`): the one place that talks to MLflow.

``publish`` can be repeated at any time, after any outage or kill: what has been sent is noted in FOLDER/mlflow.json
after every call. What is sent twice all the same is there once: MLflow stores the same point (metric, step, time,
value) once, and runs and models bear the record's id, by which they are found before they are made a second time.
"""

import hashlib
import importlib.util
import json
import logging
import os
import re
import shlex
import socket
import threading
from pathlib import Path
from typing import Any

from datagen.common.errors import DsffnetError, TrackingError, UnsafeFileError, first_line_of
from datagen.common.files import lock_within
from datagen.common.printable import printable, printable_lines
from training.tracking.mirror_state import MetricRows, note_sent, read_sent, unsent_artifacts, unsent_rows
from training.tracking.mlflow_store import EXPERIMENT_TAGS, mark_experiment, prepare_store, require_inside
from training.tracking.model_registry import Registration
from training.tracking.record import EXPERIMENT, Record, Server, find_records, parent_of, read_record
from training.tracking.threads import background

os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "10")
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
os.environ.setdefault("MLFLOW_SKIP_PIP_REQUIREMENTS_CHECK", "true")
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")

log = logging.getLogger(__name__)
_PARENT_TAG, _RECORD_TAG, _WEIGHTS_TAG = "mlflow.parentRunId", "dsffnet.record", "dsffnet.weights"
_METRICS_AT_ONCE, _PARAMETERS_AT_ONCE, _LONGEST_PARAMETER, _LONGEST_NAME = 900, 90, 5000, 250
_LOCK_SECONDS = 120.0  # to wait for another process that publishes the same record, such as a sync by hand
_NO_ANSWER = ("INTERNAL_ERROR", "TEMPORARILY_UNAVAILABLE", "DEADLINE_EXCEEDED", "REQUEST_LIMIT_EXCEEDED")


def publish(root: Path, server: Server) -> None:
    """Bring the tracking server up to date with every record below ``root``, parents first.

    Raises
    ------
    TrackingError
        The server cannot be reached or refuses; repeat later.
    """
    if importlib.util.find_spec("mlflow") is None:
        raise TrackingError(f"MLflow is not installed here. Where it is, {_how_to_sync(root, server)} sends {root}")
    import mlflow

    for chatty in ("mlflow", "alembic"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)  # raised, too
    logging.getLogger("urllib3.connectionpool").setLevel(logging.ERROR)  # each retry would be a line
    failures: list[Exception] = []
    try:
        prepare_store(server)
        mlflow.set_tracking_uri(server.uri)
        client = mlflow.MlflowClient(server.uri)
        _experiment(client, server, mark=True)
        for folder in find_records(root):
            _publish_record(client, server, folder, failures)
    except Exception as error:  # MLflow's stores and clients raise whatever lies below them: HTTP, SQL, cloud storage
        failures.append(error)
    if failures:
        log.debug("publishing %s failed", root, exc_info=failures[0])
        later = f". Nothing is lost: {_how_to_sync(root, server)} sends what is missing"
        raise TrackingError(
            f"MLflow at {server.uri} could not be brought up to date ({_reason(failures[0])})"
            f"{'' if isinstance(failures[0], UnsafeFileError) else later}"
        ) from failures[0]


def _reason(error: BaseException | None) -> str:
    """What failed, in few words: below MLflow's, requests' and urllib3's errors of a connection lies the system's."""
    if isinstance(error, DsffnetError):
        return str(error)
    cause = error
    while cause:
        if words := _NO_CONNECTION.get(type(cause)):
            return words
        cause = cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__)
    return first_line_of(error) if error else ""


_NO_CONNECTION: dict[type[BaseException], str] = {
    socket.gaierror: "the host cannot be found",
    ConnectionRefusedError: "it refuses connections",
    TimeoutError: "it does not answer",
}


def _how_to_sync(root: Path, server: Server | None) -> str:
    uri = f" --tracking-uri {shlex.quote(server.uri)}" if server and not server.own else ""  # named, it is trusted
    return f"dsffnet sync {shlex.quote(str(root))}{uri}"


def _publish_record(client: Any, server: Server, folder: Path, failures: list[Exception]) -> None:
    """Publish one record. What the server refuses about it is kept for the end, lest it keep back the others."""
    from mlflow.exceptions import MlflowException

    record = read_record(folder)
    if record is None:
        return
    try:
        with lock_within(folder, ".mlflow.lock").acquire(timeout=_LOCK_SECONDS):
            _Publication(client, server, folder, record).run()
    except MlflowException as error:
        if error.error_code in _NO_ANSWER:
            raise
        failures.append(error)
    except (DsffnetError, ArithmeticError, ValueError, LookupError, TypeError) as error:  # it holds what none can send
        failures.append(error)


class _Publication:
    """What one record still has to send to one server."""

    def __init__(self, client: Any, server: Server, folder: Path, record: Record) -> None:
        self.client, self.server, self.folder, self.record = client, server, folder, record
        self.sent = read_sent(folder, server.uri)

    def run(self) -> None:
        run = self._known_run()
        if run is None:
            run = self._find_or_create_run()
            self.sent = {"run": run.info.run_id, "offsets": {}, "artifacts": {}}
            self._note()
        require_inside(run.info.artifact_uri, self.server)
        self._send_parameters(run.data)
        if self.record.tags != self.sent.get("tags", {}):
            self._send_tags()
        if self.record.dataset:
            self._once("dataset", self._send_dataset)
        self._send_metrics()
        self._send_artifacts()
        if self.record.model and self.record.status == "FINISHED":
            self._once("model", self._register_model)
            about = self.record.model_about
            if about != self.sent.get("about", "") and self._registration().describe(self.record.model, about):
                self._note(about=about)
        if self.record.status != self.sent.get("status"):
            self._send_status()

    def _known_run(self) -> Any:
        """The run that was noted, None where there is none, it is deleted, or it is none of our experiment's."""
        from mlflow.exceptions import MlflowException

        if "run" not in self.sent:
            return None
        try:
            run = self.client.get_run(self.sent["run"])
            is_ours = run.info.experiment_id == _experiment(self.client, self.server)
            return run if is_ours and run.info.lifecycle_stage == "active" else None
        except MlflowException as error:
            if error.error_code == "RESOURCE_DOES_NOT_EXIST":
                return None
            raise

    def _find_or_create_run(self) -> Any:
        """The run of this record, which a kill may have kept from being noted; a new one where there is none."""
        experiment = _experiment(self.client, self.server)
        if not self._runs_of_record(experiment):
            self._create_run(experiment)
        first, *doubles = self._runs_of_record(experiment)
        for double in doubles:  # a request whose answer was lost is repeated below us, and each makes a run
            if not double.data.metrics and not double.data.params:
                self.client.delete_run(double.info.run_id)
        return first

    def _runs_of_record(self, experiment: str) -> list[Any]:
        return list(
            self.client.search_runs(
                [experiment], f"tags.`{_RECORD_TAG}` = '{self.record.id}'", order_by=["attributes.start_time ASC"]
            )
        )

    def _create_run(self, experiment: str) -> None:
        tags = {"kind": self.record.kind, _RECORD_TAG: self.record.id}
        parent = self._parent()
        if parent:
            tags[_PARENT_TAG] = parent
        name = printable(self.record.name)[:_LONGEST_NAME]
        self.client.create_run(experiment, start_time=self.record.started, run_name=name, tags=tags)

    def _parent(self) -> str | None:
        """The parent's run; None for a run that was copied away from its workflow, which stands alone."""
        parent = parent_of(self.folder, self.record)
        return read_sent(parent, self.server.uri).get("run") if parent else None

    def _send_parameters(self, there: Any) -> None:
        """Parameters that the server lacks; it lets none change, so what a resumed run has otherwise becomes a tag."""
        from mlflow.entities import Param, RunTag

        given = {_key(key): _value(value) for key, value in self.record.parameters.items()}
        new = [Param(key, value) for key, value in given.items() if key not in there.params]
        for start in range(0, len(new), _PARAMETERS_AT_ONCE):
            self.client.log_batch(self.sent["run"], params=new[start : start + _PARAMETERS_AT_ONCE])
        changed = {f"changed.{key}": value for key, value in given.items() if there.params.get(key, value) != value}
        tags = [RunTag(key, value) for key, value in changed.items() if there.tags.get(key) != value]
        if tags:
            self.client.log_batch(self.sent["run"], tags=tags)

    def _send_tags(self) -> None:
        from mlflow.entities import RunTag

        tags = [RunTag(_key(key), _value(value)) for key, value in self.record.tags.items()]
        self.client.log_batch(self.sent["run"], tags=tags)
        self._note(tags=self.record.tags)

    def _send_dataset(self) -> None:
        from mlflow.data.code_dataset_source import CodeDatasetSource
        from mlflow.data.meta_dataset import MetaDataset
        from mlflow.entities import DatasetInput, InputTag

        about = self.record.dataset or {}
        source = CodeDatasetSource(tags={key: printable(value) for key, value in about.items()})
        name, digest = printable(about.get("name", "?"))[:_LONGEST_NAME], about.get("manifest_sha256", "?")[:36]
        dataset = MetaDataset(source, name=name, digest=digest)
        context = InputTag("mlflow.data.context", self.record.kind)
        self.client.log_inputs(self.sent["run"], [DatasetInput(dataset._to_mlflow_entity(), [context])])

    def _send_metrics(self) -> None:
        from mlflow.entities import Metric

        for name, offset, rows in unsent_rows(self.folder, self.sent["offsets"], values=_METRICS_AT_ONCE):
            self._send_rows(rows)
            self.sent["offsets"][name] = offset
            self._note()
        if self.record.metrics != self.sent.get("metrics", {}):
            moment = self.record.measured or self.record.started  # not now: sent twice, it must be the same point
            points = [Metric(_key(key), value, moment, 0) for key, value in self.record.metrics.items()]
            self.client.log_batch(self.sent["run"], metrics=points)
            self._note(metrics=self.record.metrics)

    def _send_rows(self, rows: MetricRows) -> None:
        from mlflow.entities import Metric

        points = [
            Metric(_key(key), float(value), int(row.get("time", 0) * 1000), row["step"])
            for row in rows
            for key, value in row.items()
            if key not in ("time", "step")
        ]
        for start in range(0, len(points), _METRICS_AT_ONCE):
            self.client.log_batch(self.sent["run"], metrics=points[start : start + _METRICS_AT_ONCE])

    def _send_artifacts(self) -> None:
        for each in unsent_artifacts(self.folder, self.record.artifacts, self.sent["artifacts"]):
            self.client.log_artifact(self.sent["run"], str(each.path), each.place or None)
            self.sent["artifacts"][each.name] = each.stamp
            self._note()

    def _register_model(self) -> None:
        self._registration().register(self.record.model or "", parent=self._parent())

    def _registration(self) -> Registration:
        marks = {_RECORD_TAG: self.record.id, _WEIGHTS_TAG: self.record.model_version}
        experiment = _experiment(self.client, self.server)
        return Registration(self.client, experiment, self.sent["run"], self.folder, marks)

    def _send_status(self) -> None:
        if self.record.status == "RUNNING":
            self.client.update_run(self.sent["run"], status="RUNNING")
        else:
            ended = self.record.ended and max(
                self.record.ended, self.record.started
            )  # the clock may have been put back
            self.client.set_terminated(self.sent["run"], self.record.status, ended)
        self._note(status=self.record.status)

    def _once(self, key: str, send: Any) -> None:
        digest = hashlib.sha256(json.dumps(self.record.dataset).encode()).hexdigest()
        value = digest if key != "model" else self.record.model_version
        if self.sent.get(key) != value:
            send()
            self._note(**{key: value})

    def _note(self, **changes: Any) -> None:
        self.sent |= changes
        note_sent(self.folder, self.server.uri, self.sent)


def _key(name: str) -> str:
    """A name of a metric, parameter or tag with what MLflow refuses in one replaced; folders may have given it."""
    parts = re.sub(r"[^/\w.\- :]", "_", name)[:_LONGEST_NAME].split("/")
    return "/".join(part for part in parts if part not in ("", ".", "..")) or "_"


def _value(text: str) -> str:
    return printable_lines(text)[:_LONGEST_PARAMETER]


def _experiment(client: Any, server: Server, *, mark: bool = False) -> str:
    """The experiment's id; it is made where it is not there, and with ``mark`` gets the tags that it lacks."""
    from mlflow.exceptions import MlflowException

    found = client.get_experiment_by_name(EXPERIMENT)
    if found is None:
        place = server.artifacts.as_uri() if server.artifacts else None
        try:
            return str(client.create_experiment(EXPERIMENT, place, tags=EXPERIMENT_TAGS))
        except MlflowException:  # another process made it meanwhile, or it cannot be made
            found = client.get_experiment_by_name(EXPERIMENT)
            if found is None:
                raise
    if mark:
        try:
            mark_experiment(client, found)
        except MlflowException as error:  # of a shared server, where others alone may change it: runs are sent
            log.debug("the experiment at %s keeps its tags: %s", server.uri, first_line_of(error))
    return str(found.experiment_id)


class Mirror:
    """Publishes in the background while the block runs; an outage is reported once, and made up for later.

    Parameters
    ----------
    root
        The folder whose records are published.
    every, after_failure
        Seconds between publications, and before the next one after an outage.
    """

    def __init__(self, root: Path, server: Server, *, every: float = 5.0, after_failure: float = 30.0) -> None:
        self._root, self._server, self._every, self._after_failure = root, server, every, after_failure
        self._failed: TrackingError | None = None
        self._on = importlib.util.find_spec("mlflow") is not None
        self._background = background(self._follow, name="mlflow-mirror")

    def __enter__(self) -> "Mirror":
        if self._on:
            self._background.__enter__()
        else:  # records wait for a machine that has it
            log.warning("MLflow is not installed here, so nothing is sent. Later: %s", _how_to_sync(self._root, None))
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Publish once more; where that fails, raise its TrackingError, or warn where the block has failed already."""
        if not self._on:
            return
        self._background.__exit__(None, None, None)
        self._publish()
        if self._failed and kind is None:
            raise self._failed
        if self._failed:
            log.warning("%s", self._failed)

    def _follow(self, stop: threading.Event) -> None:
        pause = 0.1
        while not stop.wait(pause):
            was_well = self._failed is None
            self._publish()
            if self._failed and was_well:
                reason = _reason(self._failed.__cause__)
                log.warning("MLflow at %s gets nothing now (%s); the work goes on", self._server.uri, reason)
            pause = self._every if self._failed is None else self._after_failure

    def _publish(self) -> None:
        try:
            publish(self._root, self._server)
            if self._failed is not None:
                log.warning("MLflow at %s is back and has been sent what it missed", self._server.uri)
            self._failed = None
        except TrackingError as error:
            self._failed = error
