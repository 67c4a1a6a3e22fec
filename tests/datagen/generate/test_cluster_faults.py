"""Generation on real Ray nodes and a real S3 server: whatever is killed, the bytes come out as undisturbed."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from datagen.common.errors import DatasetError
from datagen.generate import append, generate, repair
from datagen.recipe import DatasetRecipe
from datagen.store import open_dataset
from datagen.store.objects import read_bytes, write_bytes
from datagen.store.schema import open_group
from datagen.store.verify import find_faults
from tests.support.commands import wait_for
from tests.support.damage.object_store import BUCKET, s3_server
from tests.support.files import tree_hash
from tests.support.recipes import tiny_dataset, tiny_training
from training.recipes.training import EvaluationRecipe
from workflows.pipeline.evaluate import evaluate_weights, is_evaluated
from workflows.pipeline.run_folder import RunFolder
from workflows.pipeline.tasks import TaskRunner
from workflows.pipeline.train import train_model

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(300)]
ROOT = Path(__file__).parents[3]


def many_shards() -> DatasetRecipe:
    """384 shards of some milliseconds each, so that there is time to kill something in the middle."""
    return tiny_dataset(
        body={"family": "leg", "rings": 120, "segments": 60},
        poses={"seen": 96, "unseen": 48},
        identities={"training": 6, "evaluation": 4},
        store={"poses_per_shard": 3},
    )


def shard_count(url: Path) -> int:
    return len(list(url.rglob("vertices/c/*/*/0/0")))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("undisturbed") / "leg.zarr"
    generate(many_shards(), str(path))
    return path


_DRIVER = """
import os, sys, ray
from datagen.generate import generate, ray_runner
from tests.datagen.generate.test_cluster_faults import many_shards
ray.init(address=os.environ.get("FAULT_ADDRESS", "local"), num_cpus=None if "FAULT_ADDRESS" in os.environ else 2,
         include_dashboard=False, log_to_driver=False)
generate(many_shards(), sys.argv[1], run=ray_runner)
"""


def start_driver(url: Path, **environment: str) -> subprocess.Popen[bytes]:
    # RAY_AUTH_MODE stays: a cluster of this process has it, and refuses a driver that does not
    kept = {n: value for n, value in os.environ.items() if not n.startswith("RAY_") or n == "RAY_AUTH_MODE"}
    command = [sys.executable, "-c", _DRIVER, str(url)]
    return subprocess.Popen(command, cwd=ROOT, env={**kept, "PYTHONPATH": str(ROOT), **environment})


def test_sigkill_of_the_driver(undisturbed: Path, tmp_path: Path) -> None:
    url = tmp_path / "leg.zarr"
    driver = start_driver(url)
    wait_for(lambda: shard_count(url) >= 10)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    with pytest.raises(DatasetError, match=r"incomplete|no dataset"):
        open_dataset(str(url))
    assert start_driver(url).wait(120) == 0
    assert tree_hash(url) == tree_hash(undisturbed)


def test_loss_of_a_node(undisturbed: Path, tmp_path: Path) -> None:
    from ray.cluster_utils import Cluster

    url = tmp_path / "leg.zarr"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        lost = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        driver = start_driver(url, FAULT_ADDRESS=cluster.address)
        wait_for(lambda: shard_count(url) >= 12)
        assert shard_count(url) < 384, "work is left when the node goes"
        cluster.remove_node(lost, allow_graceful=False)
        assert driver.wait(200) == 0
    finally:
        cluster.shutdown()
    assert tree_hash(url) == tree_hash(undisturbed)


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """URL of an empty bucket; credentials and address are in the environment, as they would be for a person."""
    with s3_server():
        yield BUCKET


def objects(url: str) -> dict[str, bytes]:
    """Every object below a URL."""
    import s3fs

    files = s3fs.S3FileSystem()
    files.invalidate_cache()
    root = url.removeprefix("s3://")
    return {path.removeprefix(f"{root}/"): files.cat_file(path) for path in files.find(root)}


def test_a_dataset_on_s3_holds_the_same_bytes(bucket: str, dataset: str) -> None:
    made = generate(tiny_dataset(), f"{bucket}/leg.zarr")
    local = {str(p.relative_to(dataset)): p.read_bytes() for p in Path(dataset).rglob("*") if p.is_file()}
    assert objects(f"{bucket}/leg.zarr") == local
    here = open_dataset(dataset)
    assert np.array_equal(made.vertices(3), here.vertices(3)) and np.array_equal(
        made.vertices(4, 7), here.vertices(4, 7)
    )


def test_faults_on_s3_are_found_and_mended(bucket: str, dataset: str) -> None:
    url = f"{bucket}/faulty.zarr"
    generate(tiny_dataset(), url)
    whole, group = objects(url), open_group(url, mode="r+")
    path = "grid/training/0/vertices/c/1/1/0/0"
    content = bytearray(read_bytes(group, path) or b"")
    content[len(content) // 2] ^= 1
    write_bytes(group, path, bytes(content))
    with pytest.raises(DatasetError, match=rf"{path} is damaged.*--repair"):
        open_dataset(url).vertices(1)
    faults = list(find_faults(url))
    assert [fault.path for fault in faults] == [path]
    repair(url, tiny_dataset(), faults)
    assert objects(url) == whole


def test_growing_and_removing_on_s3(bucket: str, tmp_path: Path) -> None:
    url = f"{bucket}/growing.zarr"
    generate(tiny_dataset(), url)
    grown = append(url, seen=9)
    local = generate(grown.recipe, str(tmp_path / "leg.zarr"))
    assert grown.uuid == local.uuid
    assert objects(url).keys() == {str(p.relative_to(local.url)) for p in Path(local.url).rglob("*") if p.is_file()}
    again = generate(tiny_dataset(), url, fresh=True)
    assert again.recipe == tiny_dataset() and grown.arrays.shards()[-1].path not in objects(url)


def test_two_generators_on_one_s3_dataset_do_no_harm(bucket: str, dataset: str) -> None:
    """There is no lock on S3: both write the same objects whole, so that nothing is lost."""
    url = f"{bucket}/twice.zarr"
    code = (
        "from datagen.generate import generate; from tests.support.recipes import tiny_dataset; import sys;"
        "generate(tiny_dataset(), sys.argv[1])"
    )
    both = [subprocess.Popen([sys.executable, "-c", code, url], cwd=ROOT) for _ in range(2)]
    assert [process.wait(120) for process in both] == [0, 0]
    assert open_dataset(url).uuid == open_dataset(dataset).uuid and not list(find_faults(url))


def test_a_dataset_on_s3_is_trained_on_and_evaluated_as_one_on_the_disk(
    bucket: str, dataset: str, tmp_path: Path
) -> None:
    url, recipe = f"{bucket}/evaluated.zarr", EvaluationRecipe(emd_points=16, examples=1, chunk=2)
    generate(tiny_dataset(), url)
    tasks = TaskRunner(local=True)
    for place, name in ((url, "afar"), (dataset, "here")):
        run = RunFolder(tmp_path / name)
        train_model(tiny_training(), place, run, parent=None, tasks=tasks)
        evaluate_weights(recipe, place, run.path, parent=run.path, tasks=tasks)
        assert is_evaluated(recipe, place, run)
    afar, here = (tmp_path / name / "evaluation" for name in ("afar", "here"))
    assert (afar / "rows.csv").read_bytes() == (here / "rows.csv").read_bytes()
    names = {str(path.relative_to(here)) for path in here.rglob("*") if path.is_file()}
    assert names == {str(path.relative_to(afar)) for path in afar.rglob("*") if path.is_file()}
    assert "evaluated.zarr" in (afar / "tables.md").read_text()


def test_ray_workers_write_to_s3(bucket: str, undisturbed: Path) -> None:
    url = f"{bucket}/ray.zarr"
    command = [sys.executable, "-c", _DRIVER, url]
    subprocess.run(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True, timeout=200)
    assert (
        open_dataset(url).attributes["manifest_sha256"] == open_dataset(str(undisturbed)).attributes["manifest_sha256"]
    )


def test_a_zarr_group_of_somebody_else_on_s3_is_left_alone(bucket: str) -> None:
    import zarr

    theirs = f"{bucket}/theirs.zarr"
    zarr.create_group(theirs, attributes={"precious": 1})
    before = objects(theirs)
    for fresh in (False, True):
        with pytest.raises(DatasetError, match="not a dataset of this project"):
            generate(tiny_dataset(), theirs, fresh=fresh)
    assert objects(theirs) == before


def test_a_bucket_that_is_not_there(bucket: str) -> None:
    with pytest.raises(DatasetError, match=r"s3://nowhere/leg.zarr"):
        open_dataset("s3://nowhere/leg.zarr")
