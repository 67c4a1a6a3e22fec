"""Banks: the same batches from every cache, files that survive accidents, memory that stays bounded."""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from datagen.common import resources
from datagen.common.errors import DatasetError, RecipeError, StorageError
from datagen.generate import generate
from datagen.store import Dataset, open_dataset
from tests.support.disk import small_disk
from tests.support.files import flip_bit, truncate
from tests.support.mixed import mixed_dataset
from tests.support.recipes import tiny_dataset
from tests.training.data.test_batch import same
from training.data import cache_policy as room
from training.data import mmap_cache as mapped
from training.data.batch import Batch, EdgeTable
from training.data.cache_policy import Room, choose
from training.data.prefetch import Share
from training.data.triples import TripleOrder
from training.data.vertex_bank import Bank, open_bank, streamed_bank
from training.data.vertex_layout import Layout
from training.objectives.losses import transfer_loss

CACHES = ("device", "memory", "mapped", "stream")
CPU = torch.device("cpu")


@pytest.fixture(scope="module", params=["one body", "mixed bodies"])
def legs(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """180 or 200 training meshes: more than a streamed bank's fewest slots."""
    recipe = tiny_dataset() if request.param == "one body" else mixed_dataset()
    recipe = recipe.model_copy(update={"poses": recipe.poses.model_copy(update={"seen": 60})})
    return open_dataset(generate(recipe, str(tmp_path_factory.mktemp("legs") / "legs.zarr")).url)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for memory-mapped files, which is also the default one."""
    monkeypatch.setenv("DSFFNET_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "vertices"


def training_bank(dataset: Dataset, cache: Any = "memory", **options: Any) -> Bank:
    return open_bank(dataset, dataset.identities("training"), cache=cache, **options)


def small_stream(dataset: Dataset, device: torch.device = CPU) -> Bank:
    """A streamed bank of 64 meshes, the fewest."""
    identities = dataset.identities("training")
    table = EdgeTable(dataset, identities, device=device)
    return streamed_bank(Layout(dataset, identities), table, device=device, memory=0)


def steps(
    bank: Bank, dataset: Dataset, *, count: int, first: int = 0, parts: int = 2
) -> list[tuple[Share, list[Batch]]]:
    order = TripleOrder(dataset.identities("training"), dataset.grid.poses("seen"), batch=12, seed=5)
    shares = islice(bank.prefetch(order.batches(first_step=first, parts=parts)), count)
    return [(share, [bank.batch(triples) for triples in share]) for share in shares]


def equal_steps(one: list[tuple[Share, list[Batch]]], other: list[tuple[Share, list[Batch]]]) -> bool:
    return len(one) == len(other) and all(
        all(np.array_equal(a, b) for a, b in zip(shares, others, strict=True))
        and all(same(a, b) for a, b in zip(batches, their, strict=True))
        for (shares, batches), (others, their) in zip(one, other, strict=True)
    )


def test_every_cache_gives_the_same_bits_in_the_same_order(
    legs: Dataset, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = steps(training_bank(legs), legs, count=36, first=4)
    for cache in CACHES[1:]:
        bank = training_bank(legs, cache)
        assert bank.place == cache and equal_steps(steps(bank, legs, count=36, first=4), expected), cache
        bank.close()
    monkeypatch.setattr(resources, "container_memory", lambda: 1)
    cold = training_bank(legs, "mapped")
    assert equal_steps(steps(cold, legs, count=36, first=4), expected), "a file larger than memory is read ahead, too"
    cold.close()
    streamed = small_stream(legs)
    assert equal_steps(steps(streamed, legs, count=36, first=4), expected), "64 meshes at a time"
    assert all(same(streamed.batch(share[0]), batches[0]) for share, batches in expected[:5]), "not prefetched"
    streamed.close()
    assert list(folder.glob("*.vertices")) == [mapped.mapped_path(Layout(legs, legs.identities("training")), folder)]


@pytest.mark.gpu
def test_a_gpu_gets_the_same_bits_from_every_cache(legs: Dataset, folder: Path) -> None:
    expected = steps(training_bank(legs), legs, count=20)
    device = torch.device("cuda", 0)
    for bank in [*(training_bank(legs, cache, device=device) for cache in CACHES), small_stream(legs, device)]:
        found = steps(bank, legs, count=20)
        assert all(batch.truth.device == device for _, batches in found for batch in batches)
        there = [(share, [batch.to("cpu") for batch in batches]) for share, batches in found]
        assert equal_steps(there, expected), bank.where
        bank.close()


@pytest.mark.gpu
def test_a_gpu_that_holds_the_meshes_is_not_waited_for(legs: Dataset) -> None:
    """torch raises where the processor would wait for the GPU, in the batch and in both losses."""
    bank = training_bank(legs, "device", device="cuda")
    order = TripleOrder(legs.identities("training"), range(60), batch=12, seed=5)
    shares = list(islice(order.batches(first_step=0), 3))
    for step, (triples,) in enumerate(shares):  # the first works out how each topology's edges touch
        torch.cuda.set_sync_debug_mode("error" if step else "default")
        try:
            batch = bank.batch(triples)
            prediction = batch.target.clone().requires_grad_()
            loss, _ = transfer_loss(
                prediction, truth=batch.truth, target=batch.target, edges=batch.edges, counts=batch.target_counts
            )
            loss.backward()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    bank.close()


def test_a_streamed_bank_holds_no_more_than_it_may(legs: Dataset) -> None:
    bank = small_stream(legs)
    assert len(bank) == 60 * len(legs.identities("training")) > 64
    steps(bank, legs, count=25)
    assert len(bank._meshes._slot) == 64 == len(set(bank._meshes._slot.values()))  # type: ignore[attr-defined]
    bank.close()
    threads = [thread.name for thread in threading.enumerate()]
    assert not any(name.startswith(("stream", "lookahead")) for name in threads), threads


def test_a_batch_larger_than_a_streamed_banks_memory(legs: Dataset) -> None:
    bank = small_stream(legs)
    (triples,) = next(TripleOrder(legs.identities("training"), range(60), batch=60, seed=0).batches(first_step=0))
    with pytest.raises(RecipeError, match=r"streaming has memory for 64 .*Lower training\.batch"):
        bank.batch(triples)
    bank.close()


def test_a_bank_knows_what_it_does_not_have(dataset: str) -> None:
    bank = training_bank(open_dataset(dataset))
    with pytest.raises(KeyError, match="identity 3 in pose 1"):
        bank.batch(np.array([[0, 0, 3, 1]]))
    with pytest.raises(KeyError, match="identity 1 in pose 9"):
        bank.batch(np.array([[0, 9, 1, 1]]))


@pytest.mark.parametrize("cache", CACHES)
@pytest.mark.parametrize("damage", [flip_bit, truncate, Path.unlink], ids=["bit flip", "truncated", "missing"])
def test_a_damaged_shard_is_the_datasets_own_error(spoilable: Path, folder: Path, cache: str, damage: Any) -> None:
    opened = open_dataset(str(spoilable))
    for shard in (spoilable / "identity" / "0001" / "vertices" / "c").rglob("0"):
        if shard.is_file():
            damage(shard)
    with pytest.raises(DatasetError, match=r"shard identity/0001/vertices/c/0/0/0 is .*verify .* --repair"):
        steps(training_bank(opened, cache), opened, count=2)
    assert not list(folder.glob("*.vertices")) and not list(folder.glob("*.partial"))


class TestMapped:
    def test_the_next_run_reads_the_file_and_not_the_dataset(self, spoilable: Path, folder: Path) -> None:
        opened = open_dataset(str(spoilable))
        expected = steps(training_bank(opened, "mapped"), opened, count=3)
        shutil.rmtree(spoilable / "identity" / "0000" / "vertices" / "c")
        bank = training_bank(opened, "mapped")
        assert equal_steps(steps(bank, opened, count=3), expected)
        assert bank.where.endswith("that is there already")

    @pytest.mark.parametrize("accident", ["bit flip", "truncated", "foreign", "longer"])
    def test_a_file_that_is_not_what_was_written_is_made_again(self, dataset: str, folder: Path, accident: str) -> None:
        opened, said = open_dataset(dataset), []
        expected = steps(training_bank(opened, "mapped"), opened, count=2)
        (path,) = folder.glob("*.vertices")
        sound = path.read_bytes()
        if accident == "foreign":
            path.write_bytes(b"x" * len(sound))
        elif accident == "longer":
            path.write_bytes(sound + b"\0")
        else:
            {"bit flip": flip_bit, "truncated": truncate}[accident](path)
        bank = training_bank(opened, "mapped", log=said.append)
        assert equal_steps(steps(bank, opened, count=2), expected) and path.read_bytes() == sound
        assert len(said) == 1 and f"{path} is not what was written" in said[0]

    def test_other_identities_and_other_datasets_have_other_files(
        self, dataset: str, legs: Dataset, folder: Path
    ) -> None:
        opened = open_dataset(dataset)
        for identities in ([0, 1], [1, 0], [0, 1, 2]):
            open_bank(opened, identities, cache="mapped")
        open_bank(legs, [0, 1], cache="mapped")
        assert len(list(folder.glob("*.vertices"))) == 4

    def test_what_a_killed_writer_leaves_behind_harms_nobody(self, dataset: str, folder: Path) -> None:
        code = (
            "import os, signal, sys; from training.data import mmap_cache as mapped; "
            "from training.data.vertex_bank import open_bank\n"
            "from datagen.store import open_dataset\n"
            "write = mapped._write_all\n"
            "def killed(descriptor, content, place):\n"
            "    write(descriptor, content[:1000], place); os.kill(os.getpid(), signal.SIGKILL)\n"
            "mapped._write_all = killed\n"
            "open_bank(open_dataset(sys.argv[1]), [0, 1, 2], cache='mapped')"
        )
        done = subprocess.run([sys.executable, "-c", code, dataset], cwd=Path(__file__).parents[3], check=False)
        assert done.returncode == -signal.SIGKILL
        assert len(list(folder.glob("*.partial"))) == 1 and not list(folder.glob("*.vertices"))
        opened, said = open_dataset(dataset), []
        bank = training_bank(opened, "mapped", log=said.append)
        assert equal_steps(steps(bank, opened, count=3), steps(training_bank(opened), opened, count=3))
        assert not list(folder.glob("*.partial")) and not said

    def test_many_processes_at_once_make_one_file(
        self, dataset: str, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        written, write = [], mapped._write
        monkeypatch.setattr(mapped, "_write", lambda path, layout: (written.append(path), write(path, layout)))
        opened = open_dataset(dataset)
        with ThreadPoolExecutor(4) as pool:
            banks = list(pool.map(lambda _: training_bank(opened, "mapped"), range(4)))
        assert len(written) == 1
        assert len({float(steps(bank, opened, count=1)[0][1][0].truth.sum()) for bank in banks}) == 1

    def test_a_person_is_told_of_a_long_wait(self, dataset: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(mapped, "_PATIENCE", 0.05)
        opened, said = open_dataset(dataset), []
        path = mapped.mapped_path(Layout(opened, opened.identities("training")), folder)
        holding, release = threading.Event(), threading.Event()

        def other() -> None:
            with mapped._locked(path, log=said.append):
                holding.set()
                release.wait(20)

        def log(line: str) -> None:
            said.append(line)
            release.set()

        with ThreadPoolExecutor(1) as pool:
            pool.submit(other)
            holding.wait(20)
            training_bank(opened, "mapped", log=log)
        assert said == [f"waiting for another process that makes {path}"]

    def test_a_full_disk_names_the_file_and_leaves_nothing(self, dataset: str, tmp_path: Path) -> None:
        opened = open_dataset(dataset)
        with small_disk(tmp_path / "small", kibibytes=8) as disk:
            layout = Layout(opened, opened.identities("training"))
            path = mapped.mapped_path(layout, disk)
            with pytest.raises(StorageError, match=rf"could not write the cache {path} .*No space left") as error:
                mapped.map_vertices(layout, disk, log=print)
            assert "--set training.cache_folder=" in str(error.value)
            assert {file.suffix for file in disk.iterdir()} <= {".lock"}

    def test_a_folder_that_cannot_be_made(self, dataset: str, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(StorageError, match=r"could not write the cache .*Not a directory"):
            training_bank(open_dataset(dataset), "mapped", folder=tmp_path / "file" / "below")

    def test_auto_streams_where_the_file_cannot_be_written_and_says_so(
        self, dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        opened, said = open_dataset(dataset), []
        expected = steps(training_bank(opened), opened, count=3)
        monkeypatch.setattr(room, "memory_room", lambda: Room("memory", 1, 0.5))
        (tmp_path / "file").write_text("")
        bank = training_bank(opened, "auto", folder=tmp_path / "file" / "below", log=said.append)
        assert bank.place == "stream" and "below cannot be written" in bank.where
        assert len(said) == 1 and "streamed, not mapped: could not write the cache" in said[0]
        assert equal_steps(steps(bank, opened, count=3), expected)
        bank.close()

    def test_those_who_waited_check_the_file_at_the_same_time(
        self, dataset: str, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Three checks of what another process wrote meet: under the lock each would wait for the one before it."""
        together, check = threading.Barrier(3), mapped._fault
        opened = open_dataset(dataset)
        layout = Layout(opened, opened.identities("training"))
        path = mapped.mapped_path(layout, folder)

        def checked(at: Path, its: Layout, *, log: Any) -> str | None:
            if at.exists():
                together.wait(20)
            return check(at, its, log=log)

        monkeypatch.setattr(mapped, "_fault", checked)
        with ThreadPoolExecutor(3) as pool, mapped._locked(path, log=print):
            waiting = [pool.submit(mapped.map_vertices, layout, folder, log=print) for _ in range(3)]
            time.sleep(0.3)  # all have seen that there is no file
            mapped._write(path, layout)
        assert all(torch.equal(each.result(), waiting[0].result()) for each in waiting)

    def test_a_person_is_told_of_a_long_check(
        self, dataset: str, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        opened, said = open_dataset(dataset), []
        training_bank(opened, "mapped", log=said.append)
        monkeypatch.setattr(mapped, "_PATIENCE", -1)
        training_bank(opened, "mapped", log=said.append)
        assert len(said) == 1 and re.search(r"checking .*\.vertices \(.* kB\) against its checksums", said[0])


class TestChoice:
    """``auto`` takes the first place with room; a place that was asked for is taken if it can be."""

    SIZE = 10**9

    def chosen(
        self, monkeypatch: pytest.MonkeyPatch, cache: Any, device: str, free: dict[str, float], **more: Any
    ) -> Any:
        rooms = {
            "device_room": lambda _: Room("device memory", int(free["device"] * 1e9), 0.4),
            "memory_room": lambda: Room("memory", int(free["memory"] * 1e9), 0.5),
            "disk_room": lambda folder: Room(f"disk of {folder}", int(free["disk"] * 1e9), 0.8),
        }
        for name, function in rooms.items():
            monkeypatch.setattr(room, name, function)
        options = {"mapped": lambda: Path("/caches/not-there.vertices")} | more
        return choose(cache, self.SIZE, device=torch.device(device), **options)

    @pytest.mark.parametrize(
        ("device", "free", "place", "why"),
        [
            ("cuda", {"device": 80, "memory": 99, "disk": 99}, "device", "device memory: 1.0 GB of 80.0 GB free"),
            ("cuda", {"device": 2, "memory": 99, "disk": 99}, "memory", "memory: 1.0 GB of 99.0 GB free"),
            ("cpu", {"memory": 2.1, "disk": 99}, "memory", "memory: 1.0 GB of 2.1 GB free"),
            ("cpu", {"memory": 1.9, "disk": 99}, "mapped", "1.0 GB, 99.0 GB free on the disk of /caches"),
            ("cpu", {"memory": 1.9, "disk": 1.2}, "stream", "streamed, 1.0 GB in all: .*memory .1.9 GB free.*disk"),
        ],
    )
    def test_auto(
        self, monkeypatch: pytest.MonkeyPatch, device: str, free: dict[str, float], place: str, why: str
    ) -> None:
        found = self.chosen(monkeypatch, "auto", device, free)
        assert found.place == place
        assert re.search(why, found.why), found.why

    def test_memory_must_hold_a_copy_for_each_process(self, monkeypatch: pytest.MonkeyPatch) -> None:
        free = {"memory": 10, "disk": 99}
        assert self.chosen(monkeypatch, "auto", "cpu", free, sharers=4).why.endswith("(4 processes: 4.0 GB)")
        assert self.chosen(monkeypatch, "auto", "cpu", free, sharers=8).place == "mapped"

    def test_a_file_that_is_there_needs_no_room(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        (tmp_path / "its.vertices").touch()
        found = self.chosen(
            monkeypatch, "auto", "cpu", {"memory": 1, "disk": 0}, mapped=lambda: tmp_path / "its.vertices"
        )
        assert found.place == "mapped"

    @pytest.mark.parametrize("cache", ["auto", "memory", "stream"])
    def test_a_folder_is_looked_for_only_where_a_file_is_to_be_mapped(
        self, monkeypatch: pytest.MonkeyPatch, cache: str
    ) -> None:
        def nowhere() -> Path:
            raise RuntimeError("Could not determine home directory.")

        assert self.chosen(monkeypatch, cache, "cpu", {"memory": 99, "disk": 99}, mapped=nowhere).place != "mapped"

    def test_a_user_without_a_home_has_a_folder_among_the_temporary_ones(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        def nowhere() -> Path:
            raise RuntimeError("Could not determine home directory.")

        for name in ("DSFFNET_CACHE", "XDG_CACHE_HOME"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr(Path, "home", nowhere)
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        assert room.default_folder() == tmp_path / f"dsffnet-{os.getuid()}" / "vertices"

    def test_device_on_a_cpu_is_memory(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert self.chosen(monkeypatch, "device", "cpu", {"memory": 10, "disk": 10}).place == "memory"

    def test_a_place_asked_for_is_taken_though_it_gets_tight_but_not_beyond(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        assert self.chosen(monkeypatch, "memory", "cpu", {"memory": 1.1, "disk": 9}).place == "memory"
        with pytest.raises(RecipeError, match=r"'memory', but 1.0 GB are .*900.0 MB free.*training.cache=auto"):
            self.chosen(monkeypatch, "memory", "cpu", {"memory": 0.9, "disk": 9})

    def test_the_limit_of_a_container_counts(self, tmp_path: Path) -> None:
        for name, value in {"max": "8000", "current": "5000", "stat": "anon 3000\ninactive_file 1500\n"}.items():
            (tmp_path / f"memory.{name}").write_text(value)
        assert resources.container_memory(tmp_path) == 4500
        (tmp_path / "memory.max").write_text("max\n")
        assert resources.container_memory(tmp_path) > 10**15

    def test_what_is_free_here_is_known(self, tmp_path: Path) -> None:
        assert 0 < room.memory_room().free < 10**15
        assert room.disk_room(tmp_path / "not" / "yet").free > 0
        assert os.fspath(room.default_folder()).endswith("vertices")
