"""The subcommands that make and move data, as processes: what a person types, sees, and gets as exit status."""

import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np

from datagen.bodies import load_body
from datagen.store import open_dataset
from tests.support.commands import command, fails
from tests.support.files import flip_bit, tree_hash


class Hostile:
    """Pickles as a call of os.system."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, (f"touch {self.trace}",)


def made(out: Path, *extra: object) -> Path:
    done = command("generate", "--recipe", "smoke", "--local", "--out", out, *extra)
    assert done.returncode == 0, done.stderr
    return out


def test_append_then_make_it_again_from_its_own_attributes(tmp_path: Path) -> None:
    data = made(tmp_path / "leg.zarr")
    grown = command("append", data, "--training-identities", "6", "--unseen-poses", "20", "--local")
    assert grown.returncode == 0 and "6 (0-3, 7-8) training" in grown.stdout
    assert "nothing was to be appended" not in grown.stdout
    assert "nothing was to be appended" in command("append", data, "--unseen-poses", "20", "--local").stdout
    assert "2 training, 8 unseen" in grown.stdout
    again = command("generate", "--recipe", data, "--out", tmp_path / "again.zarr", "--local")
    assert again.returncode == 0 and tree_hash(data) == tree_hash(tmp_path / "again.zarr")


def test_inspect_draws_beside_the_dataset_unless_told_otherwise(tmp_path: Path) -> None:
    data, elsewhere = made(tmp_path / "data" / "leg.zarr"), tmp_path / "elsewhere"
    elsewhere.mkdir()
    shown = command("inspect", data, folder=elsewhere)
    picture = tmp_path / "data" / "leg-contact-sheet.png"
    assert f"picture: {picture}" in shown.stdout and picture.stat().st_size > 10_000
    assert not list(elsewhere.iterdir())
    assert "identities          4 (0-3) training, 3 (4-6) evaluation" in shown.stdout
    picture.unlink()
    assert command("inspect", data, "--picture", "none", folder=tmp_path).returncode == 0 and not picture.exists()


def test_inspect_says_why_it_draws_no_picture(spoilable: Path, tmp_path: Path) -> None:
    path = "grid/training/0/vertices/c/0/0/0/0"
    flip_bit(spoilable / path)
    shown, asked = command("inspect", spoilable), command("inspect", spoilable, "--picture", tmp_path / "q.png")
    fails(asked, 1, "no picture was made", path, f"dsffnet verify {spoilable} --repair")
    assert shown.returncode == 0 and f"warning: no picture was made: {spoilable}: shard {path}" in shown.stderr
    assert not list(tmp_path.glob("*.png"))


def test_export_then_import(tmp_path: Path) -> None:
    data = made(tmp_path / "leg.zarr")
    out = command("export", data, "--layout", "npt-obj", "--out", tmp_path / "meshes", "--identities", "4", "5", "6")
    assert out.returncode == 0 and "files written" in out.stdout
    back = command(
        "import", "npt", tmp_path / "meshes", "--out", tmp_path / "back.zarr", "--local",
        "--set", "data.identities.training=0", "data.identities.evaluation=3",
        "data.poses.seen=20", "data.poses.unseen=12",
    )  # fmt: skip
    assert back.returncode == 0, back.stderr
    first, second = open_dataset(str(data)), open_dataset(str(tmp_path / "back.zarr"))
    assert np.array_equal(first.vertices(5), second.vertices(1)) and np.array_equal(first.faces(5), second.faces(1))


def test_a_stand_in_is_made_and_used(tmp_path: Path) -> None:
    file = tmp_path / "smpl.npz"
    written = command("stand-in", "smpl", "--out", file, "--topology", "notoes_collapse3pc")
    assert written.returncode == 0 and "It is not the licensed model" in written.stdout
    small = ["data.identities.training=2", "data.identities.evaluation=2", "data.poses.seen=4", "data.poses.unseen=2"]
    used = command(
        "generate", "--recipe", "smpl-paper", "--set", f"data.body.path={file}", *small,
        "--out", tmp_path / "x.zarr", "--local",
    )  # fmt: skip
    assert used.returncode == 0 and "SMPL neutral sha256:" in used.stdout


def test_a_hostile_pickle_is_refused_by_name(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    (tmp_path / "model.pkl").write_bytes(pickle.dumps(Hostile(trace)))
    refused = command("convert-body", tmp_path / "model.pkl", "--out", tmp_path / "model.npz")
    fails(refused, 1, "system", "model.pkl")
    assert not trace.exists() and not (tmp_path / "model.npz").exists()


def test_a_moved_model_file_is_named_when_going_on(tmp_path: Path) -> None:
    command("stand-in", "smpl", "--out", tmp_path / "a.npz", "--topology", "notoes_collapse3pc")
    small = ["data.identities.training=2", "data.identities.evaluation=2", "data.poses.seen=4", "data.poses.unseen=2"]
    data = tmp_path / "x.zarr"
    path = f"data.body.path={tmp_path}"
    made = command("generate", "--recipe", "smpl-paper", "--set", f"{path}/a.npz", *small, "--out", data, "--local")
    assert made.returncode == 0, made.stderr
    (tmp_path / "a.npz").rename(tmp_path / "b.npz")
    load_body.cache_clear()  # another process would not have it
    fails(command("append", data, "--unseen-poses", "3", "--local"), 1, "a.npz")
    (data / "grid/training/0/vertices/c/0/0/0/0").unlink()
    assert command("verify", data, "--repair", "--set", f"{path}/b.npz").returncode == 0
    assert command("append", data, "--unseen-poses", "3", "--local").returncode == 0, "the new path was kept"
    fails(command("append", data, "--unseen-poses", "4", "--set", "data.poses.seed=4"), 2, "can only change where")


def test_s3_without_credentials_is_one_error(tmp_path: Path) -> None:
    nothing = {
        "AWS_ENDPOINT_URL": "http://127.0.0.1:9",
        "AWS_EC2_METADATA_DISABLED": "true",
        "AWS_CONFIG_FILE": "/none",
    }
    made = command("generate", "--recipe", "smoke", "--out", "s3://bucket/x.zarr", "--local", **nothing)
    fails(made, 1, "s3://bucket/x.zarr", "credentials")
