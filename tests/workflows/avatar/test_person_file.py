"""Files of one's own scans: what they hold is read, where people stand is undone, and what cannot be is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.common.errors import RecipeError
from tests.support.shapes.outfits import person_arrays, stockinged
from workflows.avatar.person_file import read_person


def _file(folder: Path, **changed: Any) -> Path:
    arrays = {name: its for name, its in {**person_arrays(), **changed}.items() if its is not None}
    np.savez(folder / "ann.npz", **arrays)
    return folder / "ann.npz"


def test_people_stand_at_home(tmp_path: Path) -> None:
    found, true = read_person(_file(tmp_path)), stockinged()
    assert found.name == "ann" and len(found.source) == 64
    assert np.abs(found.scans - true.scans).max() < 1e-5, "turned back, and moved back"
    for frame in range(len(found.scans)):
        off = np.linalg.norm(found.scan(frame).vertices - found.posed(frame).vertices, axis=1)
        assert np.abs(off - 0.01).max() < 1e-3, "the stocking is a centimetre off the body in every pose"
    assert not found.rotations[:, 0].any()
    assert found.seen == [0, 1, 2] and found.unseen == [3] and set(found.parts) == {1}


def test_a_file_may_say_parts_and_what_is_seen(tmp_path: Path) -> None:
    parts = np.arange(384) % 3
    found = read_person(_file(tmp_path, parts=parts, seen=np.array([True, False, True, False])))
    assert found.seen == [0, 2] and np.array_equal(found.parts, parts)


def test_where_nobody_moves_no_translations_are_needed(tmp_path: Path) -> None:
    arrays = person_arrays()
    found = read_person(_file(tmp_path, scans=arrays["scans"] - arrays["translations"][:, None], translations=None))
    assert np.abs(found.scans - stockinged().scans).max() < 1e-5


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"scans": None}, r"has no array 'scans'. docs/avatar.md says"),
        ({"poses": None}, r"has no array 'poses'"),
        ({"scans": np.zeros((3, 9, 3))}, r"'scans' has shape \[3, 9, 3\] .* must be numbers \[4, 9, 3\], which is"),
        ({"body_weights": np.ones((384, 5))}, r"'body_weights' has shape \[384, 5\] .* must be numbers \[384, 24\]"),
        ({"body_weights": np.ones((384, 24))}, r"those of a vertex sum to one"),
        ({"faces": np.full((2, 3), 384)}, r"'faces' goes from 384 to 384, but there are 384 vertices. Count from 0"),
        ({"faces": np.zeros((2, 3))}, r"'faces' has shape .* float64; it must be whole numbers"),
        ({"parts": np.zeros(384, int)}, r"from 1 on for cloth, of which there must be some"),
        ({"parts": np.arange(384) - 1}, r"'parts' must be 0 for skin|'parts' holds -1"),
        ({"seen": np.zeros(4, bool)}, r"some that are learned from"),
        ({"translations": np.full((4, 3), np.nan)}, r"'translations' holds what is no finite number"),
        ({"scans": 100 * person_arrays()["scans"]}, r"the body in pose 0 lies \d+ cm from scan 0 .* both in metres"),
    ],
)
def test_what_cannot_be_is_refused(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=said):
        read_person(_file(tmp_path, **changed))


def test_a_missing_or_broken_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"no file of scans at .*nobody.npz"):
        read_person(tmp_path / "nobody.npz")
    (tmp_path / "broken.npz").write_bytes(b"PK nothing")
    with pytest.raises(RecipeError, match=r"is no .npz file of plain arrays"):
        read_person(tmp_path / "broken.npz")
