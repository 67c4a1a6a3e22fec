"""The whole chain on an S3 server that is slow, busy and loses connections: all is as it is on a disk."""

from pathlib import Path

import pytest
import torch

from datagen.generate import append, generate, inline
from datagen.store import open_dataset
from datagen.store.objects import list_objects, read_bytes
from datagen.store.schema import open_group
from datagen.store.verify import find_faults
from tests.support.damage.object_store import BUCKET, proxied, s3_server
from tests.support.recipes import tiny_dataset, tiny_training
from training.checkpoints.checkpoint import require_checkpoint
from training.engine.trainer import train
from training.evaluation.evaluate import Method, Row, evaluate
from training.recipes.training import EvaluationRecipe


def bytes_at(url: str) -> dict[str, bytes | None]:
    group = open_group(url)
    return {path: read_bytes(group, path) for path in list_objects(group)}


def chain(url: str, run: Path, *, cache: str) -> tuple[dict[str, torch.Tensor], list[Row]]:
    """Weights and rows of a dataset that is made, appended to, trained on and evaluated on."""
    append(generate(tiny_dataset(poses={"seen": 12, "unseen": 4}), url).url, training=8)
    train(tiny_training(cache=cache, block="60kB", steps=30), data=url, run=run)
    rows = evaluate([Method("DSFFNet", str(run))], url, EvaluationRecipe(emd_points=16, chunk=3), tasks=inline)
    return require_checkpoint(run).weights(), rows


@pytest.mark.cluster
@pytest.mark.timeout(300)
def test_a_slow_store_that_fails_now_and_then_gives_what_a_disk_gives(tmp_path: Path) -> None:
    """30 ms a request; one in a hundred is answered by 503, and one by a reset, before the answer or within it."""
    disk, remote = str(tmp_path / "leg.zarr"), f"{BUCKET}/leg.zarr"
    weights, rows = chain(disk, tmp_path / "on disk", cache="device")
    with s3_server(), proxied(tmp_path / "requests", delay=0.03, busy_every=100, lost_every=100) as proxy:
        found, measured = chain(remote, tmp_path / "on s3", cache="stream")
        assert all(torch.equal(found[name], value) for name, value in weights.items()) and measured == rows
        assert bytes_at(remote) == bytes_at(disk) and not list(find_faults(remote))
        assert len(proxy.requests()) > 400, "faults among them"
        asked = len(proxy.requests())
        assert len(open_dataset(remote).sizes) == 8 * 3 + 2 * 4
        assert len(proxy.requests()) - asked < 40, "a shard is not asked for alone"
