"""Commands say what a dataset takes before they make it, and refuse in one line what there is no room for."""

import gc
import io
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from datagen import sizes
from datagen.common.errors import RecipeError
from datagen.common.resources import free_disk
from tests.support.recipes import tiny_dataset
from workflows import full
from workflows.cli import main as cli
from workflows.pipeline import forecast, tasks
from workflows.pipeline.console import guarded
from workflows.pipeline.forecast import announce_size
from workflows.pipeline.ray_cluster import worker_count
from workflows.studies.sweep.plan import plan_sweep

Printed = pytest.CaptureFixture[str]
SMOKE = ["--recipe", "smoke", "--set", "data.poses.seen=4", "data.poses.unseen=2"]


def refused(run: Callable[[], object], status: int, says: str, printed: Printed) -> None:
    """It ends with that status and one line on standard error."""
    with pytest.raises(SystemExit) as ended:
        run()
    error = printed.readouterr().err
    assert ended.value.code == status and error.startswith("error: ") and error.count("\n") == 1, error
    assert says in error


def generate(out: Path, *options: str) -> None:
    cli.main(["generate", *SMOKE, "--local", "--out", str(out), *options])


def test_the_size_is_the_first_thing_said_and_only_where_there_is_something_to_make(
    tmp_path: Path, capsys: Printed
) -> None:
    generate(tmp_path / "x.zarr")
    assert "] generate: 34 meshes of 96 vertices, " in capsys.readouterr().out.splitlines()[0]
    generate(tmp_path / "x.zarr")
    assert "generate:" not in capsys.readouterr().out
    cli.main(["append", str(tmp_path / "x.zarr"), "--unseen-poses", "3", "--local"])
    assert "] generate: 37 meshes of 96 vertices, " in capsys.readouterr().out.splitlines()[0]


def test_a_disk_that_is_too_small_is_said_before_anything_is_made_and_yes_goes_on(
    tmp_path: Path, capsys: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sizes, "free_disk", lambda folder: 1_000)
    refused(lambda: generate(tmp_path / "x.zarr"), 1, "its disk has 1.0 kB left", capsys)
    assert not list(tmp_path.iterdir())
    generate(tmp_path / "x.zarr", "--yes")
    capsys.readouterr()
    generate(tmp_path / "x.zarr")  # there is nothing to make
    append = ["append", str(tmp_path / "x.zarr"), "--training-identities", "60", "--local"]
    refused(lambda: cli.main(append), 1, "its disk has 1.0 kB left", capsys)


def test_object_stores_have_no_end(capsys: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sizes, "free_disk", lambda folder: 0)
    announce_size(tiny_dataset(), "s3://bucket/x.zarr", anew=True, yes=False)
    assert "38 meshes of 32 vertices" in capsys.readouterr().out


HUGE = ["--recipe", "smoke", "--set", "data.identities.training=1000000000000"]


@pytest.mark.parametrize(
    "command",
    [
        ["generate", *HUGE],
        ["sweep", *HUGE, "--vary", "training.seed=1,2"],
        ["compare", "--recipe", "small", *HUGE[2:]],
        ["ablation", *HUGE[2:]],
        ["full", *HUGE],
    ],
    ids=lambda command: command[0],
)
def test_a_million_million_identities_are_refused_by_every_command(
    command: list[str], tmp_path: Path, capsys: Printed
) -> None:
    name, *words = [*command, "--out", str(tmp_path / "out"), "--fresh"]
    run = (lambda: guarded(lambda: full.main(words))) if name == "full" else (lambda: cli.main([name, *words]))
    refused(run, 2, "of memory, but", capsys)
    assert not list(tmp_path.iterdir())


def test_appending_a_million_million_is_refused(spoilable: Path, capsys: Printed) -> None:
    refused(
        lambda: cli.main(["append", str(spoilable), "--seen-poses", str(10**12), "--local"]), 2, "Lower data.", capsys
    )
    refused(lambda: cli.main(["append", str(spoilable), "--seen-poses", "9" * 400, "--local"]), 2, "has 63", capsys)


@pytest.mark.parametrize(
    ("meshes", "address", "local", "workers"),
    [(5_000, "", False, 64), (5_000, "", True, 1), (5_000, "head:6379", False, 1), (4_999, "", False, 1)],
)
def test_memory_is_asked_for_the_workers_that_this_machine_has_at_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, meshes: int, address: str, local: bool, workers: int
) -> None:
    """One where little is made, which needs no Ray; one of a cluster, whose other machines have memory of their own."""
    asked: list[int] = []

    def size(recipe: object, workers: int) -> SimpleNamespace:
        asked.append(workers)
        return SimpleNamespace(meshes=meshes)

    monkeypatch.setattr(forecast, "size_of", size)
    monkeypatch.setattr(forecast, "worker_count", lambda: 64)
    monkeypatch.setenv("RAY_ADDRESS", address)
    announce_size(tiny_dataset(), str(tmp_path), anew=True, yes=True, local=local)
    assert max(asked) == workers


@pytest.mark.parametrize(("container", "workers"), [(None, 64), (8.0, 8), (0.5, 1)])
def test_in_a_container_memory_is_asked_for_the_workers_that_it_may_have(
    monkeypatch: pytest.MonkeyPatch, container: float | None, workers: int
) -> None:
    from ray._private import utils

    monkeypatch.delenv("RAY_USE_MULTIPROCESSING_CPU_COUNT", raising=False)
    monkeypatch.setattr("os.cpu_count", lambda: 64)
    monkeypatch.setattr("multiprocessing.cpu_count", lambda: 64)
    monkeypatch.setattr(utils, "_get_docker_cpus", lambda: container)
    assert worker_count() == workers


def test_workers_that_memory_has_no_room_for_may_be_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "RAY_FROM_MESHES", 1)
    monkeypatch.setattr(forecast, "worker_count", lambda: 10**9)
    with pytest.raises(RecipeError, match=r"Lower .*, or work in one process: --local, where the command has it"):
        announce_size(tiny_dataset(), str(tmp_path), anew=True, yes=True)


def test_the_disk_of_a_link_is_where_it_leads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "out").symlink_to(tmp_path / "other" / "not-yet")
    asked: list[Path] = []
    monkeypatch.setattr("shutil.disk_usage", lambda path: asked.append(path) or SimpleNamespace(free=7))
    assert free_disk(tmp_path / "out" / "x.zarr") == 7 and asked == [tmp_path / "other"]


def test_a_grid_of_a_hundred_million_trials_is_refused() -> None:
    vary = [f"training.{key}={','.join(map(str, range(1, 101)))}" for key in ("seed", "batch", "steps", "log_every")]
    with pytest.raises(RecipeError, match="the varied values make 100,000,000 trials, more than 10,000"):
        plan_sweep(recipe="smoke", shared=[], vary=vary)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        np._core._exceptions._ArrayMemoryError((1 << 50,), np.dtype("u1")),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 4 bytes.\nAt alloc_cpu.cpp"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_memory_that_runs_out_anywhere_is_one_line(
    error: Exception, tmp_path: Path, capsys: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make_shard(*_: object) -> None:
        raise error

    monkeypatch.setattr("datagen.generate.shards.make_shard", make_shard)
    with pytest.raises(SystemExit) as ended:
        generate(tmp_path / "x.zarr")
    last = capsys.readouterr().err.splitlines()[-1]
    assert ended.value.code == 1 and "error: memory ran out (" in last and "lower counts, vertices" in last
    monkeypatch.undo()
    generate(tmp_path / "x.zarr")  # nothing was lost


def test_what_a_terminal_should_not_be_sent_is_escaped(capsys: Printed) -> None:
    def main() -> None:
        raise RecipeError("no recipe '\x1b]0;owned\x07\n2'")

    refused(lambda: guarded(main), 2, r"'\x1b]0;owned\x07\n2'", capsys)


def test_text_that_the_shell_cannot_show_is_written_with_escapes(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii", errors="strict"))
    guarded(lambda: print("Grüße"))
    sys.stdout.flush()
    assert raw.getvalue() == b"Gr\\xfc\\xdfe\n"


def test_a_name_that_the_shells_encoding_lacks_is_refused_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch, capsys: Printed
) -> None:
    monkeypatch.setattr(sys, "getfilesystemencoding", lambda: "ascii")
    monkeypatch.setattr(sys, "argv", ["dsffnet", "inspect", "d\udcc3\udca4ta.zarr"])
    refused(cli.main, 2, "cannot be read in this shell's encoding, ascii. Set PYTHONUTF8=1 and run again", capsys)


def test_a_name_that_is_no_text_at_all_is_one_line(capsys: Printed) -> None:
    def no_text() -> None:
        "caf\udce9".encode()

    refused(lambda: guarded(no_text), 1, r"'caf\udce9' is not UTF-8 text", capsys)


def test_a_command_looks_for_garbage_less_often() -> None:
    before = gc.get_threshold()
    try:
        guarded(lambda: None)
        assert gc.get_threshold() == (10_000, 20, 50)
    finally:
        gc.set_threshold(*before)


def test_waiting_threads_fall_asleep_unless_told_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("OMP_WAIT_POLICY", "active")
    guarded(lambda: None)
    assert "GOMP_SPINCOUNT" not in os.environ
    monkeypatch.delenv("OMP_WAIT_POLICY")
    guarded(lambda: None)
    assert os.environ["GOMP_SPINCOUNT"] == "20000"
    monkeypatch.setenv("GOMP_SPINCOUNT", "7")
    guarded(lambda: None)
    assert os.environ["GOMP_SPINCOUNT"] == "7"
