"""An .npz that is damaged, or holds pickles: whoever reads it says which, what is wrong, and what to do, in a line."""

import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from datagen.bodies.smpl_family.model_file import read_model
from datagen.common.errors import BodyError, DsffnetError, MeshError, RecipeError
from datagen.poses.amass_files import find_motions, read_frames
from datagen.poses.pose_files import MAKE_ONE, read_pose_file
from tests.support.damage.archives import DAMAGES
from tests.support.shapes.models import arrays_of
from tests.support.shapes.outfits import person_arrays
from workflows.avatar.person_file import read_person
from workflows.demo.poses import read_poses


class Reader(NamedTuple):
    """What reads a file, what that holds where it is whole, and the error of one that is not."""

    read: Callable[[Path], object]
    arrays: Callable[[], dict[str, Any]]
    error: type[DsffnetError]
    says: str


def _poses(*shape: int, **others: Any) -> dict[str, Any]:
    return {"poses": np.random.default_rng(0).normal(size=shape), **others}


_MOTION = r"(is no \.npz file|cannot be read as a motion) \(.+\)\. Fetch it again or take it away"
READERS = {
    "poses": Reader(
        read_pose_file,
        partial(_poses, 6, 1, 3, joints=np.array(["pelvis"])),
        RecipeError,
        rf"is no \.npz file of plain arrays \(.+\)\. {MAKE_ONE}",
    ),
    "motion": Reader(
        lambda path: read_frames(find_motions(str(path))[0]), partial(_poses, 50, 156), RecipeError, _MOTION
    ),
    "body model": Reader(
        read_model,
        partial(arrays_of, "smpl"),
        BodyError,
        r"(is damaged|cannot be read as a pickle) \(.+\); copy or download it again",
    ),
    "scans": Reader(
        read_person, person_arrays, RecipeError, r"is no \.npz file of plain arrays \(.+\)\. docs/avatar\.md says"
    ),
    "the page's poses": Reader(
        read_poses, partial(_poses, 50, 156), MeshError, rf"cannot be read as \.npz \(.+\)|{_MOTION}"
    ),
}


def _refused(path: Path, reader: Reader) -> str:
    with pytest.raises(reader.error, match=rf"x\.npz ({reader.says})") as caught:
        reader.read(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", READERS)
def test_damaged_archives_are_one_error(tmp_path: Path, name: str, damage: str) -> None:
    reader, path = READERS[name], tmp_path / "x.npz"
    np.savez_compressed(path, **reader.arrays())
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    said = _refused(path, reader)
    assert damage != "a header of 1e13 rows" or ".npy is shorter than its shape" in said
    assert name != "body model" or ("is damaged" in said) == zipfile.is_zipfile(path), "else it is taken for a pickle"


@pytest.mark.parametrize("name", [name for name in READERS if name != "body model"])
def test_pickles_are_never_loaded(tmp_path: Path, name: str) -> None:
    """Of body models, which are published as pickles, some are: tests/datagen/bodies/test_safe_pickle.py."""
    reader, path = READERS[name], tmp_path / "x.npz"
    arrays = reader.arrays()
    np.savez(path, **arrays | {next(iter(arrays)): np.array([{"a": 1}], dtype=object)})
    _refused(path, reader)
