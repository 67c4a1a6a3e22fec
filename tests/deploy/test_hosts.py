"""Several hosts for real: a Ray cluster, MLflow and S3, each on a host of its own (:mod:`hosts`), and faults between.

Whatever is cut off, slow, killed or replaced, the dataset's bytes, the weights and the evaluation are in the end those
of an undisturbed run; where a job gave up, it said so in one line, and the same command went on.
"""

import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hosts import Host, Lab, why_not

from datagen.generate import generate
from datagen.store import open_dataset
from datagen.store.verify import find_faults
from tests.support.commands import wait_for
from tests.support.files import tree_hash
from training.checkpoints.checkpoint import load_checkpoint
from training.tracking.journal import read_journal
from training.tracking.record import find_records, read_record
from workflows.recipe.loader import load_recipe

pytestmark = [pytest.mark.hosts, pytest.mark.timeout(2400)]
WELL_SECONDS = 400
JOB_SECONDS = 900
STEPS = 120
DATA = ["data.poses.seen=40", "data.store.poses_per_shard=2"]
TRAINING = [f"training.steps={STEPS}", "training.evaluate_every=60"]
RAY = "http://ray-head:8265"
MLFLOW = "http://mlflow:5000"
HOW_MANY_CPUS = f"""
import json, os, urllib.request
headers = {{"Authorization": "Bearer " + os.environ["RAY_AUTH_TOKEN"]}}
request = urllib.request.Request("{RAY}/api/v0/nodes", headers=headers)
nodes = json.load(urllib.request.urlopen(request, timeout=10))["data"]["result"]["result"]
print(sum(int(node["resources_total"].get("CPU", 0)) for node in nodes if node["state"] == "ALIVE"))
"""
MAKE_BUCKET = "import boto3; boto3.client('s3').create_bucket(Bucket='datasets')"
RUNS = f"""
import json, sys, mlflow
client = mlflow.MlflowClient("{MLFLOW}")
experiment = client.get_experiment_by_name("dsffnet").experiment_id
for record in sys.argv[1:]:
    (run,) = client.search_runs([experiment], f"tags.`dsffnet.record` = '{{record}}'")
    points = client.get_metric_history(run.info.run_id, "loss/total")
    print(json.dumps([run.info.status, [point.step for point in points]]))
"""


class Cluster:
    """A head without CPUs, two workers of one CPU each, MLflow, S3, and a client that submits jobs."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.head, self.mlflow, self.s3, self.client = map(lab.add, ("ray-head", "mlflow", "s3", "client"))
        self.workers = [lab.add(f"ray-worker-{number}") for number in (1, 2)]
        lab.serve("ray-head", self.head)
        self.wait_for_service("ray-head", self.head)
        for worker in self.workers:
            lab.serve("ray-worker", worker)
        self.wait_until_well()
        lab.serve("mlflow", self.mlflow)
        self.wait_for_service("mlflow", self.mlflow)
        self.s3.start(["python", "-m", "moto.server", "-H", "0.0.0.0", "-p", "5000"], lab.environment())
        wait_for(lambda: self.ask("python", "-c", MAKE_BUCKET)[0] == 0, WELL_SECONDS, what="S3", every=1)

    def wait_for_service(self, service: str, host: Host) -> None:
        wait_for(lambda: self.lab.is_well(service, host), WELL_SECONDS, what=f"{service} on {host.name}", every=1)

    def wait_until_well(self) -> None:
        """Until the head knows two workers, and their own health checks say so too."""
        counted = ("python", "-c", HOW_MANY_CPUS)
        wait_for(lambda: self.ask(*counted) == (0, "2\n"), WELL_SECONDS, what="two workers at the head", every=2)
        for worker in self.workers:
            self.wait_for_service("ray-worker", worker)

    def replace(self, host: Host, service: str, *, address: str) -> Host:
        """Power a host off, and have another of its name do what it did."""
        host.end()
        new = self.lab.add(host.name, address=address)
        self.lab.serve(service, new)
        return new

    def ask(self, *command: str) -> tuple[int, str]:
        """Run a command on the client; its exit status and output."""
        done = self.client.run(command, self.lab.environment(), seconds=JOB_SECONDS)
        return done.returncode, done.stdout

    def submit(self, *entrypoint: str) -> "Job":
        return Job(self, "dsffnet", "submit", f"--address={RAY}", "--working-dir=.", "--", *entrypoint)

    def folder(self, name: str) -> Path:
        """A place for a run that all hosts see."""
        return self.lab.folder / "data" / name

    def assert_mlflow_has(self, out: Path) -> None:
        """Whether MLflow has one run for each record below a folder, finished, with every point of its loss once."""
        folders = find_records(out)
        records = [record.id for record in map(read_record, folders) if record]
        status, said = self.ask("python", "-c", RUNS, *records)
        assert status == 0, said
        for folder, line in zip(folders, said.splitlines()[-len(folders) :], strict=True):
            journal = folder / "metrics.jsonl"
            assert json.loads(line) == ["FINISHED", [row["step"] for row in read_journal(journal)]], folder


class Job:
    """A command of the client's that submits a job and follows it."""

    def __init__(self, cluster: Cluster, *command: str) -> None:
        self._log = cluster.client.log
        self._from = self._log.stat().st_size if self._log.exists() else 0
        self._process = cluster.client.start(command, cluster.lab.environment())

    @property
    def said(self) -> str:
        return self._log.read_bytes()[self._from :].decode(errors="replace")

    def reaches(self, milestone: Callable[[], object]) -> None:
        """Wait for it while the job is at work."""

        def there() -> object:
            assert self._process.poll() is None, self.said
            return milestone()

        wait_for(there, JOB_SECONDS, what="the job to get there")

    def end(self) -> int:
        """Wait for the end; the exit status."""
        return self._process.wait(JOB_SECONDS)


def full_py(out: Path) -> list[str]:
    place = ["--out", str(out), "--tracking-uri", MLFLOW]
    return ["python", "workflows/full.py", "--recipe", "smoke", *place, "--set", *DATA, *TRAINING]


def generation(url: object) -> list[str]:
    return ["python", "-m", "workflows", "generate", "--recipe", "smoke", "--out", str(url), "--set", *DATA]


def training(run: Path, data: object) -> list[str]:
    place = ["--data", str(data), "--out", str(run), "--tracking-uri", MLFLOW]
    return ["python", "-m", "workflows", "train", "--recipe", "smoke", *place, "--set", *TRAINING]


def shards(data: Path) -> int:
    return len(list(data.glob("grid/*/*/vertices/c/*/*/0/0")))


def step(run: Path) -> int:
    """The step of the newest checkpoint."""
    return max((int(path.name[5:]) for path in run.glob("checkpoints/step-*")), default=0)


def learns(run: Path) -> bool:
    return 20 <= step(run) < STEPS


def require_same_weights(run: Path, undisturbed: Path) -> None:
    both = [load_checkpoint(each) for each in (run, undisturbed)]
    assert all(each and each.step == STEPS and each.finished for each in both)
    weights, wanted = (each.weights() for each in both if each)
    assert weights.keys() == wanted.keys() and all(torch.equal(weights[name], wanted[name]) for name in wanted)


def finish(cluster: Cluster, job: Job, *entrypoint: str) -> int:
    """See a job to its end: where it gives up it says so in one line, and the same command goes on. Jobs it took."""
    for jobs in (1, 2, 3):
        if job.end() == 0:
            return jobs
        told = [line for line in job.said.splitlines() if line.startswith("error: ")]
        assert any("again" in line or "is lost" in line for line in told), job.said[-6000:]
        print("\n".join(told))
        cluster.wait_until_well()
        job = cluster.submit(*entrypoint)
    raise AssertionError(job.said[-6000:])


@pytest.fixture(scope="module")
def lab() -> Iterator[Lab]:
    if reason := why_not():
        pytest.skip(reason)
    made = Lab()
    yield made
    made.end()


@pytest.fixture(scope="module")
def steady(lab: Lab) -> Cluster:
    return Cluster(lab)


@pytest.fixture
def cluster(steady: Cluster) -> Cluster:
    """The cluster, well again after the test before."""
    steady.wait_until_well()
    return steady


@pytest.fixture(scope="module")
def undisturbed(steady: Cluster) -> Path:
    """What ``ray job submit`` makes where nothing is in its way."""
    out = steady.folder("undisturbed")
    status, said = steady.ask("ray", "job", "submit", f"--address={RAY}", "--working-dir", ".", "--", *full_py(out))
    assert status == 0 and step(out / "run") == STEPS, said[-6000:]
    return out


def test_a_job_on_hosts_of_their_own(cluster: Cluster, undisturbed: Path, tmp_path: Path) -> None:
    here = generate(load_recipe("smoke", DATA).data, str(tmp_path / "here.zarr"))
    made = open_dataset(str(undisturbed / "dataset.zarr"))
    assert made.attributes["manifest_sha256"] == here.attributes["manifest_sha256"]
    assert not list(find_faults(made.url))
    cluster.assert_mlflow_has(undisturbed)


def test_a_worker_cut_off_while_a_dataset_is_made(cluster: Cluster, undisturbed: Path) -> None:
    data = cluster.folder("cut-off.zarr")
    job = cluster.submit(*generation(data))
    job.reaches(lambda: shards(data) >= 20)
    with cluster.workers[0].unplugged():
        time.sleep(60)
    finish(cluster, job, *generation(data))
    assert tree_hash(data) == tree_hash(undisturbed / "dataset.zarr")


def test_a_worker_cut_off_while_it_trains(cluster: Cluster, undisturbed: Path) -> None:
    run = cluster.folder("cut-off")
    job = cluster.submit(*training(run, undisturbed / "dataset.zarr"))
    job.reaches(lambda: learns(run))
    with cluster.workers[0].unplugged():
        time.sleep(60)
    finish(cluster, job, *training(run, undisturbed / "dataset.zarr"))
    require_same_weights(run, undisturbed / "run")


def test_a_worker_replaced_by_another_address(cluster: Cluster, undisturbed: Path) -> None:
    run = cluster.folder("replaced")
    job = cluster.submit(*training(run, undisturbed / "dataset.zarr"))
    job.reaches(lambda: learns(run))
    cluster.workers[1] = cluster.replace(cluster.workers[1], "ray-worker", address="10.77.0.99")
    finish(cluster, job, *training(run, undisturbed / "dataset.zarr"))
    require_same_weights(run, undisturbed / "run")


def test_the_head_is_lost(cluster: Cluster, undisturbed: Path) -> None:
    out = cluster.folder("head")
    job = cluster.submit(*full_py(out))
    job.reaches(lambda: learns(out / "run"))
    cluster.head = cluster.replace(cluster.head, "ray-head", address=cluster.head.address)
    assert job.end() == 1
    assert re.match(r"error: .* (is lost|does not know job)", job.said.splitlines()[-1]), job.said[-3000:]
    cluster.wait_until_well()
    finish(cluster, cluster.submit(*full_py(out)), *full_py(out))
    assert tree_hash(out / "dataset.zarr") == tree_hash(undisturbed / "dataset.zarr")
    require_same_weights(out / "run", undisturbed / "run")
    rows = [each / "run" / "evaluation" / "rows.csv" for each in (out, undisturbed)]
    assert rows[0].read_bytes() == rows[1].read_bytes()
    cluster.assert_mlflow_has(out)


def test_a_slow_link(cluster: Cluster, undisturbed: Path) -> None:
    data, run = cluster.folder("slow.zarr"), cluster.folder("slow")
    with cluster.workers[0].slowed(seconds=0.025, bits_a_second=10e6):  # 50 ms there and back
        assert cluster.submit(*generation(data)).end() == 0
        assert cluster.submit(*training(run, data)).end() == 0
    assert tree_hash(data) == tree_hash(undisturbed / "dataset.zarr")
    require_same_weights(run, undisturbed / "run")


@pytest.mark.parametrize("when", ["start", "middle"])
def test_mlflow_cut_off_and_back(cluster: Cluster, undisturbed: Path, when: str) -> None:
    run = cluster.folder(f"mlflow-{when}")
    job = None if when == "start" else cluster.submit(*training(run, undisturbed / "dataset.zarr"))
    if job:
        job.reaches((run / "record.json").exists)
    with cluster.mlflow.unplugged():
        job = job or cluster.submit(*training(run, undisturbed / "dataset.zarr"))
        job.reaches(lambda: learns(run))
    assert job.end() == 0, job.said[-6000:]
    require_same_weights(run, undisturbed / "run")
    cluster.assert_mlflow_has(run)


def test_mlflow_cut_off_at_the_end(cluster: Cluster, undisturbed: Path) -> None:
    """The one that a job cannot make up for: all is made, and one line names the command that sends it."""
    run = cluster.folder("mlflow-end")
    job = cluster.submit(*training(run, undisturbed / "dataset.zarr"))
    job.reaches(lambda: learns(run))
    with cluster.mlflow.unplugged():
        assert job.end() == 1
    sync = re.search(r"error: MLflow at .*Nothing is lost: dsffnet (sync .*) sends what is missing$", job.said, re.M)
    assert sync, job.said[-6000:]
    require_same_weights(run, undisturbed / "run")
    status, said = cluster.ask("dsffnet", *sync[1].split())
    assert status == 0, said
    cluster.assert_mlflow_has(run)


@pytest.mark.parametrize("seconds", [20, 90])
def test_s3_cut_off(cluster: Cluster, undisturbed: Path, seconds: int) -> None:
    """While a dataset is made there: for less than the minute for which it is asked again, and for more."""
    url = f"s3://datasets/{seconds}.zarr"
    job = cluster.submit(*generation(url))
    job.reaches(lambda: " shards" in job.said or "generate: " in job.said)
    with cluster.s3.unplugged():
        time.sleep(seconds)
    jobs = finish(cluster, job, *generation(url))
    assert jobs == 1 or seconds > 60
    run = cluster.folder(f"s3-{seconds}")
    assert cluster.submit(*training(run, url)).end() == 0
    require_same_weights(run, undisturbed / "run")


def start_node(cluster: Cluster, node: int, run: Path, undisturbed: Path) -> Any:
    """Start one of torchrun's two nodes, with a rank each."""
    launcher = ["python", "-m", "torch.distributed.run", "--nnodes=2", "--nproc-per-node=1", f"--node-rank={node}"]
    meeting = ["--master-addr=ray-worker-1", "--master-port=29500", "-m", "training.engine"]
    given = undisturbed / "run" / "recipe.yaml", undisturbed / "dataset.zarr", run, "timeout=20"
    return cluster.workers[node].start([*launcher, *meeting, *map(str, given)], cluster.lab.environment())


def test_torchrun_on_two_hosts_of_which_one_is_cut_off(cluster: Cluster, undisturbed: Path) -> None:
    run = cluster.folder("torchrun")
    nodes = [start_node(cluster, node, run, undisturbed) for node in (0, 1)]
    wait_for(lambda: learns(run), JOB_SECONDS, what="a checkpoint")
    with cluster.workers[1].unplugged():
        assert all(node.wait(240) == 1 for node in nodes)
    told = [line for line in cluster.workers[0].log.read_text().splitlines() if "error: another rank has ended" in line]
    assert len(told) == 1 and "same command again" in told[0]
    nodes = [start_node(cluster, node, run, undisturbed) for node in (0, 1)]
    assert [node.wait(JOB_SECONDS) for node in nodes] == [0, 0]
    require_same_weights(run, undisturbed / "run")
