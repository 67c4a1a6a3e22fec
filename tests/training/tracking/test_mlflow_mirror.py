"""The MLflow mirror: what is shown, and that outages, kills and repeats leave neither gaps nor duplicates."""

import json
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import mlflow
import numpy as np
import pytest
from mlflow.protos.databricks_pb2 import PERMISSION_DENIED

from datagen.common.errors import TrackingError
from datagen.mesh.geometry import Mesh
from datagen.store import open_dataset
from tests.support.commands import wait_for
from tests.support.recipes import tiny_training
from tests.support.workflows import recorded_workflow
from training.engine.trainer import train
from training.inference.domain_check import seen_by
from training.inference.registered_model import download_weights
from training.inference.transfer import PoseTransfer
from training.tracking import mlflow_mirror as tracking
from training.tracking.journal import Journal
from training.tracking.mirror_state import read_sent
from training.tracking.mlflow_mirror import Mirror, publish
from training.tracking.mlflow_store import experiment_in
from training.tracking.model_registry import Registration
from training.tracking.record import (
    ALIAS,
    EXPERIMENT,
    Server,
    begin_record,
    end_record,
    find_records,
    flatten,
    read_record,
    update_record,
    write_record,
)


@pytest.fixture
def server(empty_store: Path, tmp_path: Path) -> Server:
    (tmp_path / "mlflow.db").write_bytes(empty_store.read_bytes())
    return Server(f"sqlite:///{tmp_path / 'mlflow.db'}", artifacts=tmp_path / "mlartifacts")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A workflow's folder with a parent record, a child, metrics and an artifact."""
    return recorded_workflow(tmp_path / "workflow")


def runs_of(server: Server) -> dict[str, Any]:
    """The runs by name, of which no two have the same."""
    client = mlflow.MlflowClient(server.uri)
    found = client.search_runs([client.get_experiment_by_name(EXPERIMENT).experiment_id])
    runs = {run.info.run_name: run for run in found}
    assert len(runs) == len(found), "a run was made twice"
    return runs


def ids_of(server: Server) -> dict[str, str]:
    return {name: run.info.run_id for name, run in runs_of(server).items()}


def history(server: Server, run: Any, key: str) -> list[tuple[int, float]]:
    points = mlflow.MlflowClient(server.uri).get_metric_history(run.info.run_id, key)
    return sorted((point.step, point.value) for point in points)


def test_parent_child_parameters_metrics_artifacts_status(root: Path, server: Server) -> None:
    end_record(root / "run", "FINISHED")
    end_record(root, "FAILED")
    publish(root, server)
    runs = runs_of(server)
    parent, child = runs["quick"], runs["train"]
    assert child.data.tags["mlflow.parentRunId"] == parent.info.run_id
    assert (parent.info.status, child.info.status) == ("FAILED", "FINISHED")
    assert child.data.params == {"batch": "8"} and child.data.metrics["final"] == 0.5
    assert history(server, child, "loss/total") == [(step, 1 / step) for step in range(1, 6)]
    assert [a.path for a in mlflow.MlflowClient(server.uri).list_artifacts(child.info.run_id, "figures")] == [
        "figures/curve.png"
    ]


def test_a_clock_that_was_put_back_gives_no_run_that_ends_before_it_began(root: Path, server: Server) -> None:
    started = read_record(root / "run").started
    update_record(root / "run", status="FINISHED", ended=started - 86_400_000)
    with open(root / "run" / "metrics.jsonl", "a") as file:
        file.write(json.dumps({"step": 6, "time": started / 1000 - 86_400, "loss/total": 0.1}) + "\n")
    publish(root, server)
    publish(root, server)
    child = runs_of(server)["train"]
    assert child.info.end_time >= child.info.start_time == started
    assert [step for step, _ in history(server, child, "loss/total")] == [1, 2, 3, 4, 5, 6]


def test_the_experiment_is_shown_as_training_with_columns_of_pmd(root: Path, server: Server) -> None:
    client = mlflow.MlflowClient(server.uri)
    before = client.create_experiment(EXPERIMENT, tags={"mlflow.experimentKind": "a choice of a person's"})
    publish(root, server)
    tags = client.get_experiment(before).tags
    view = json.loads(tags["mlflow.sharedViewState.dsffnet"])
    assert "metrics.`pmd_unseen`" in json.loads(view["state"])["selectedColumns"], "which full.py gives the parent"
    assert tags["mlflow.experimentKind"] == "a choice of a person's"
    client.rename_experiment(before, "another")
    publish(root, server)
    made = client.get_experiment_by_name(EXPERIMENT)
    assert made.tags["mlflow.experimentKind"] == "custom_model_development"
    assert experiment_in(server.artifacts.parent / "mlflow.db") == made.experiment_id


def test_an_experiment_that_others_alone_may_change_gets_runs_all_the_same(
    root: Path, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise mlflow.exceptions.MlflowException("Permission denied", error_code=PERMISSION_DENIED)

    mlflow.MlflowClient(server.uri).create_experiment(EXPERIMENT)
    monkeypatch.setattr(mlflow.MlflowClient, "set_experiment_tag", refuse)
    publish(root, server)
    assert set(runs_of(server)) == {"quick", "train"}


def test_a_description_is_noted_only_where_a_version_has_it(
    root: Path, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Registration, "register", lambda *_, **__: None)
    update_record(root / "run", model="dsffnet", model_about="PMD 7.5e-4")
    end_record(root / "run", "FINISHED")
    publish(root, server)
    assert "about" not in read_sent(root / "run", server.uri)
    monkeypatch.setattr(Registration, "describe", lambda *_: True)
    publish(root, server)
    assert read_sent(root / "run", server.uri)["about"] == "PMD 7.5e-4"


def artifacts_of(server: Server, run: Any, folder: str | None = None) -> set[str]:
    found = mlflow.MlflowClient(server.uri).list_artifacts(run.info.run_id, folder)
    files = {its.path for its in found if not its.is_dir}
    return files.union(*(artifacts_of(server, run, its.path) for its in found if its.is_dir))


def test_artifacts_lie_on_the_server_without_the_folders_above_them(root: Path, server: Server) -> None:
    (root / "run" / "more").mkdir()
    (root / "run" / "more" / "page.html").write_text("a page")
    update_record(root, artifacts=["run/figures", "run/more/page.html"])
    publish(root, server)
    assert artifacts_of(server, runs_of(server)["quick"]) == {"figures/curve.png", "page.html"}


def test_nothing_outside_the_folder_of_a_record_is_sent(
    root: Path, server: Server, caplog: pytest.LogCaptureFixture
) -> None:
    run = root / "run"
    for secret in (root.parent / "secret", root / "secret"):
        secret.write_text("secret")
    (run / "figures" / "linked.png").symlink_to(root.parent / "secret")
    (run / "figures" / "below").symlink_to(root.parent)
    (run / "figures" / "inside.png").symlink_to("curve.png")
    (run / "figures" / "device").symlink_to("/dev/zero")
    os.mkfifo(run / "figures" / "pipe")
    (run / "elsewhere").symlink_to(root.parent)
    (run / "system.jsonl").symlink_to(root.parent / "other.jsonl")
    (root.parent / "other.jsonl").write_text('{"step": 1, "time": 1, "secret": 42}\n')
    hostile = [
        "../../secret",
        "../secret",
        str(root.parent / "secret"),
        "/etc/hostname",
        "elsewhere",
        "elsewhere/secret",
    ]
    update_record(run, artifacts=[*hostile, "figures"])
    for _ in range(2):
        publish(root, server)
    child = runs_of(server)["train"]
    assert artifacts_of(server, child) == {"figures/curve.png", "figures/inside.png"}
    assert "secret" not in child.data.metrics
    for name in (*hostile, "figures/linked.png", "figures/device", "system.jsonl"):
        assert sum(f" names {name!r}, " in line for line in caplog.messages) == 1, name


@pytest.mark.parametrize(
    "parent", ["../../other", "../run/../..", "/", "{other}", "../../../../../../../../../../../.."]
)
def test_a_parent_that_does_not_hold_the_record_is_neither_read_nor_sent(
    root: Path, server: Server, parent: str
) -> None:
    other = root.parent / "other"
    begin_record(other, name="other", kind="workflow", parent=None, parameters={})
    publish(other, server)
    write_record(root / "run", replace(read_record(root / "run"), parent=parent.format(other=other)))
    begin_record(other, name="changed", kind="workflow", parent=None, parameters={"secret": "1"})
    assert find_records(root / "run") == [root / "run"]
    publish(root / "run", server)
    runs = runs_of(server)
    assert set(runs) == {"other", "train"} and "secret" not in runs["other"].data.params
    assert "mlflow.parentRunId" not in runs["train"].data.tags


def test_the_weights_of_another_run_are_not_registered(root: Path, server: Server, dataset: str) -> None:
    train(tiny_training(steps=4), data=dataset, run=root.parent / "private")
    (root / "run" / "run").symlink_to(root.parent / "private")
    update_record(root / "run", model="dsffnet")
    end_record(root / "run", "FINISHED")
    with pytest.raises(TrackingError, match="link that leads out of it"):
        publish(root, server)
    assert not mlflow.MlflowClient(server.uri).search_registered_models()


@pytest.mark.parametrize("note", [b"", b"null", b'{"uri": {"run": 5}}'])
def test_an_unreadable_note_is_set_aside_and_nothing_is_sent_twice(
    root: Path, server: Server, note: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    publish(root, server)
    before = ids_of(server)
    (root / "run" / "mlflow.json").write_bytes(note)
    publish(root, server)
    assert ids_of(server) == before and len(before) == 2
    assert len(history(server, runs_of(server)["train"], "loss/total")) == 5
    assert (root / "run" / "mlflow.json.unreadable").read_bytes() == note
    assert sum("mlflow.json is unreadable" in line for line in caplog.messages) == 1


def test_an_unreadable_record_of_one_stage_keeps_back_no_other(root: Path, server: Server) -> None:
    (root / "run" / "record.json").write_bytes(b"{")
    publish(root, server)
    assert set(runs_of(server)) == {"quick"}
    begin_record(root / "run", name="train", kind="train", parent=root, parameters={"batch": "8"})
    publish(root, server)
    assert set(runs_of(server)) == {"quick", "train"}


def forget(folder: Path, server: Server, *keys: str) -> None:
    """As if a kill had come between a call to the server and the note about it."""
    state = json.loads((folder / "mlflow.json").read_text())
    for key in keys:
        state[server.uri].pop(key)
    state[server.uri].setdefault("offsets", {})
    (folder / "mlflow.json").write_text(json.dumps(state))


def as_if_a_kill_had_come_before(*keys: str) -> Callable[[Path, Server], None]:
    return lambda root, server: forget(root / "run", server, *keys)


def deleted(root: Path, server: Server) -> None:
    mlflow.MlflowClient(server.uri).delete_run(runs_of(server)["train"].info.run_id)


@pytest.mark.parametrize(
    "between",
    [lambda *_: None, as_if_a_kill_had_come_before("offsets"), as_if_a_kill_had_come_before("metrics"), deleted],
    ids=["nothing", "the note of rows is lost", "the note of metrics is lost", "the run is deleted on the server"],
)
def test_whatever_happens_between_two_sendings_every_point_is_there_once(
    root: Path, server: Server, between: Callable[[Path, Server], None]
) -> None:
    publish(root, server)
    between(root, server)
    for _ in range(2):
        publish(root, server)
    child = runs_of(server)["train"]
    assert len(runs_of(server)) == 2
    assert len(history(server, child, "loss/total")) == 5 and len(history(server, child, "final")) == 1
    update_record(root / "run", metrics={"final": 0.25})
    publish(root, server)
    assert runs_of(server)["train"].data.metrics["final"] == 0.25, "a later value wins"


def test_going_on_appends_to_the_same_run(root: Path, server: Server) -> None:
    publish(root, server)
    journal = Journal(root / "run" / "metrics.jsonl")
    journal.write(5, {"loss/total": 99.0})
    journal.write(6, {"loss/total": 0.1})
    journal.close()
    begin_record(root / "run", name="train", kind="train", parent=root, parameters={"batch": "8"})
    publish(root, server)
    child = runs_of(server)["train"]
    assert [step for step, _ in history(server, child, "loss/total")] == [1, 2, 3, 4, 5, 6]


def test_an_outage_is_one_error_and_made_up_for_later(
    root: Path, server: Server, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    says = r"MLflow at http://127.0.0.1:9 could not .* \(it refuses connections\)\. Nothing is lost: dsffnet sync"
    with pytest.raises(TrackingError, match=says):
        publish(root, Server("http://127.0.0.1:9"))
    assert not caplog.records, "no line for each retry"
    publish(root, server)
    assert len(history(server, runs_of(server)["train"], "loss/total")) == 5


def test_outage_in_the_middle_of_sending(root: Path, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    from mlflow.exceptions import MlflowException

    monkeypatch.setattr(tracking, "_METRICS_AT_ONCE", 4)
    real, calls = mlflow.MlflowClient.log_batch, iter(range(100))

    def flaky(*arguments: Any, **keywords: Any) -> Any:
        if keywords.get("metrics") and next(calls) == 1:
            raise MlflowException("the server went away")
        return real(*arguments, **keywords)

    monkeypatch.setattr(mlflow.MlflowClient, "log_batch", flaky)
    with pytest.raises(TrackingError, match="the server went away"):
        publish(root, server)
    publish(root, server)
    child = runs_of(server)["train"]
    assert len(history(server, child, "loss/total")) == len(history(server, child, "learning_rate")) == 5


def test_the_mirror_reports_an_outage_once_and_raises_it_at_the_end_of_what_succeeded(
    root: Path, caplog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    worked = []
    with pytest.raises(TrackingError), Mirror(root, Server("http://127.0.0.1:9"), every=0.01):
        wait_for(lambda: "gets nothing now (it refuses connections); the work goes on" in caplog.text, 60)
        worked.append("all")
    with pytest.raises(ZeroDivisionError), Mirror(root, Server("http://127.0.0.1:9"), every=0.01):
        worked.append(1 / 0)
    assert worked == ["all"]
    assert [record.getMessage()[:32] for record in caplog.records].count("MLflow at http://127.0.0.1:9 get") == 1
    assert caplog.text.count("could not be brought up to date") == 1, "the first mirror has raised it"


def test_syncing_a_child_alone_brings_its_parent(root: Path, server: Server) -> None:
    assert [os.path.basename(folder) for folder in find_records(root / "run")] == ["workflow", "run"]
    publish(root / "run", server)
    assert set(runs_of(server)) == {"quick", "train"}


def test_records_are_not_sought_among_shards_checkpoints_and_copies(root: Path) -> None:
    before = find_records(root)
    for place in ("data.zarr/identity", "run/checkpoints/step-00000001", "mlartifacts/1"):
        (root / place).mkdir(parents=True)
        (root / place / "record.json").write_text("no record")
    assert find_records(root) == before and len(before) > 1


def test_without_mlflow_nothing_is_sent_and_one_line_says_so(root: Path, caplog, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mlflow", None)
    with Mirror(root, Server("http://127.0.0.1:9"), every=0.01):
        pass
    assert [record.message for record in caplog.records] == [
        f"MLflow is not installed here, so nothing is sent. Later: dsffnet sync {root}"
    ]
    with pytest.raises(TrackingError, match="MLflow is not installed here"):
        publish(root, Server("http://127.0.0.1:9"))


def test_another_server_gets_runs_of_its_own(root: Path, server: Server, empty_store: Path, tmp_path: Path) -> None:
    second = Server(f"sqlite:///{tmp_path / 'second.db'}", artifacts=tmp_path / "second")
    (tmp_path / "second.db").write_bytes(empty_store.read_bytes())
    publish(root, server)
    publish(root, second)
    assert len(runs_of(second)) == 2 == len(runs_of(server))


def test_a_run_that_a_kill_kept_from_being_noted_is_adopted(root: Path, server: Server) -> None:
    publish(root, server)
    before = ids_of(server)
    for folder in (root, root / "run"):
        (folder / "mlflow.json").unlink()
    begin_record(root / "run", name="train", kind="train", parent=root, parameters={"batch": "8"})
    update_record(root / "run", metrics={"final": 0.5}, parameters={"batch": "9"})
    publish(root, server)
    assert ids_of(server) == before and len(before) == 2
    child = runs_of(server)["train"]
    assert len(history(server, child, "loss/total")) == 5
    assert child.data.params == {"batch": "8"} and child.data.tags["changed.batch"] == "9"


def test_a_create_request_that_the_client_repeated_leaves_one_run(
    root: Path, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = mlflow.MlflowClient.create_run

    def twice(*arguments: Any, **keywords: Any) -> Any:
        real(*arguments, **keywords)
        return real(*arguments, **keywords)

    monkeypatch.setattr(mlflow.MlflowClient, "create_run", twice)
    publish(root, server)
    assert len(runs_of(server)) == 2
    assert len(history(server, runs_of(server)["train"], "loss/total")) == 5


def test_what_the_server_refuses_of_one_record_does_not_keep_back_the_others(
    root: Path, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mlflow.exceptions import MlflowException
    from mlflow.protos.databricks_pb2 import INVALID_PARAMETER_VALUE

    real = mlflow.MlflowClient.log_batch

    def choosy(*arguments: Any, metrics: Any = (), **keywords: Any) -> Any:
        if any(point.key == "refused" for point in metrics):
            raise MlflowException("no such metric", error_code=INVALID_PARAMETER_VALUE)
        return real(*arguments, metrics=metrics, **keywords)

    monkeypatch.setattr(mlflow.MlflowClient, "log_batch", choosy)
    update_record(root, metrics={"refused": 1.0})
    with pytest.raises(TrackingError, match="no such metric"):
        publish(root, server)
    assert len(history(server, runs_of(server)["train"], "loss/total")) == 5


def test_a_journal_put_back_from_an_older_copy_is_sent_from_its_beginning(root: Path, server: Server) -> None:
    publish(root, server)
    path = root / "run" / "metrics.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:2]) + '{"step": 6, "time": 1, "loss/total": 0}\n')
    publish(root, server)
    assert [step for step, _ in history(server, runs_of(server)["train"], "loss/total")] == [1, 2, 3, 4, 5, 6]


def test_two_processes_that_publish_at_once_make_one_run(root: Path, server: Server) -> None:
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: publish(root, server), range(4)))
    assert len(runs_of(server)) == 2
    assert len(history(server, runs_of(server)["train"], "loss/total")) == 5


def test_dataset_and_registered_model(dataset: str, tmp_path: Path, server: Server) -> None:
    """The registered model loads by alias and poses a mesh; the dataset shows as the run's input."""
    run, opened = tmp_path / "run", open_dataset(dataset)
    begin_record(tmp_path, name="whole", kind="workflow", parent=None, parameters={})
    train(tiny_training(), data=dataset, run=run)
    note = {"vertices": [7, 9], "proportions": [[0.1] * 3, [1.0] * 3]}
    (run / "provenance.json").write_text(json.dumps({"seen": note}))
    begin_record(run, name="train", kind="train", parent=tmp_path, parameters={})
    about = {"name": "leg.zarr", "uuid": opened.uuid, "manifest_sha256": opened.attributes["manifest_sha256"]}
    update_record(run, model="dsffnet", dataset=about, model_about="PMD 7.5e-4")
    end_record(run, "FINISHED")
    publish(run, server)
    mlflow.set_tracking_uri(server.uri)
    model = mlflow.pyfunc.load_model(f"models:/dsffnet@{ALIAS}")
    source, target = opened.vertices(0, 0), opened.vertices(1, 3)
    pair = {"source": source.astype(float), "target": target.astype(float)}
    posed = model.predict(pair | {"target_faces": opened.faces(1).astype(np.int64)})
    assert posed.shape == target.shape and np.isfinite(posed).all()
    options = {"align": False, "refine": 6.0}
    refined = model.predict(pair | {"target_faces": opened.faces(1).astype(np.int64)}, params=options)
    assert abs(refined - posed).max() > 1e-4, "the signature lets options through"
    weights = download_weights(f"models:/dsffnet@{ALIAS}", server.uri, tmp_path / "fetched")
    seen = seen_by(weights)
    assert seen is not None and seen.vertices == (7, 9), "with the weights goes what they were trained on"
    fetched = PoseTransfer.from_run(weights)(
        source=Mesh(pair["source"], opened.faces(0)), target=Mesh(pair["target"], opened.faces(1))
    )
    assert np.allclose(fetched.vertices, posed, atol=1e-6)
    (given,) = runs_of(server)["train"].inputs.dataset_inputs
    assert given.dataset.digest == about["manifest_sha256"][:36] and given.dataset.name == "leg.zarr"
    _described(run, server)
    _never_registered_twice(run, server)


def _described(run: Path, server: Server) -> None:
    """The parent shows the model, whose version says what it scores and how it is called; also what changes later."""
    client = mlflow.MlflowClient(server.uri)
    (shown,) = runs_of(server)["whole"].outputs.model_outputs
    version = client.get_model_version_by_alias("dsffnet", ALIAS)
    assert version.source == f"models:/{shown.model_id}"
    linked = client.get_logged_model(shown.model_id).tags["mlflow.modelVersions"]  # the run's page links it
    assert json.loads(linked) == [{"name": "dsffnet", "version": version.version}]
    assert "PMD 7.5e-4" in version.description and 'load_model("models:/dsffnet/1")' in version.description
    assert f'load_model("models:/dsffnet@{ALIAS}")' in client.get_registered_model("dsffnet").description
    update_record(run, model_about="PMD 3.5e-4")
    publish(run, server)
    assert "PMD 3.5e-4" in client.get_model_version("dsffnet", "1").description


def _never_registered_twice(run: Path, server: Server) -> None:
    """Kills behind the logging of the model, behind its version, and in the middle of its upload."""
    client = mlflow.MlflowClient(server.uri)
    experiment = client.get_experiment_by_name(EXPERIMENT).experiment_id
    publish(run, server)
    forget(run, server, "model")
    publish(run, server)
    assert len(client.search_model_versions("name='dsffnet'")) == 1, "the version was adopted"
    client.delete_registered_model("dsffnet")
    forget(run, server, "model")
    half = client.create_logged_model(
        experiment,
        source_run_id=runs_of(server)["train"].info.run_id,
        tags={"dsffnet.record": read_record(run).id, "dsffnet.weights": ""},
    )
    publish(run, server)
    (version,) = client.search_model_versions("name='dsffnet'")
    (model,) = client.search_logged_models([experiment])
    assert version.source == f"models:/{model.model_id}" != f"models:/{half.model_id}", (
        "the whole model was adopted, the half one removed"
    )
    assert len(runs_of(server)["whole"].outputs.model_outputs) == 1


def test_flatten() -> None:
    assert flatten({"a": {"b": 1, "c": {"d": (2, 3)}}, "e": None}) == {"a.b": "1", "a.c.d": "(2, 3)", "e": "None"}
