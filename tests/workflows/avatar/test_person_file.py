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


def _moved(frame: int) -> np.ndarray:
    translations = person_arrays()["translations"].copy()
    translations[frame] += 50
    return np.asarray(translations)


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
    parts = np.minimum(np.arange(384) // 100, 2)
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
        ({"scans": np.zeros((3, 9, 3))}, r"'scans' has shape \[3, 9, 3\] .* must be numbers \[4, v, 3\], which is"),
        ({"body_weights": np.ones((384, 5))}, r"'body_weights' has shape \[384, 5\] .* must be numbers \[384, 24\]"),
        ({"body_weights": np.ones((384, 24))}, r"'body_weights' of vertex 0 go down to 1 and sum to 24; they must be"),
        ({"scans": np.zeros((4, 3))}, r"'scans' has shape \[4, 3\] .* it must be numbers \[4, v, 3\]"),
        ({"faces": person_arrays()["faces"][:, ::-1]}, r"'faces' of part 1 enclose -\S+ litres, so they look inwards"),
        ({"body_faces": person_arrays()["body_faces"][:, ::-1]}, r"'body_faces' enclose -.* Turn them round"),
        ({"parts": np.arange(384) % 3}, r"no triangle of 'faces' lies in part 1 of 'parts'"),
        ({"parts": 1 + 2 * (np.arange(384) > 200)}, r"part 2 of 'parts' .* from 1 to 3 without gaps"),
        ({"joints": np.array(["a"] * 24)}, r"names 'a' twice. docs/avatar.md says"),
        ({"faces": np.full((2, 3), 384)}, r"'faces' goes from 384 to 384, but there are 384 vertices. Count from 0"),
        ({"faces": np.zeros((2, 3))}, r"'faces' has shape .* float64; it must be whole numbers"),
        ({"parts": np.zeros(384, int)}, r"'parts' goes from 0 to 0; skin is 0, cloth from 1"),
        ({"parts": np.arange(384) - 1}, r"'parts' goes from -1 to 382"),
        ({"seen": np.zeros(4, bool)}, r"0 of 4 scans are learned from, 2 are the fewest"),
        ({"translations": np.full((4, 3), np.nan)}, r"'translations' holds nan at \[0, 0\]"),
        ({"scans": np.full((4, 384, 3), 1e39)}, r"'scans' holds 1e\+39 at \[0, 0, 0\]; numbers up to 1,000"),
        ({"scans": 100 * person_arrays()["scans"]}, r"the body in pose 0 lies \d+ cm from scan 0 .* both in metres"),
        ({"translations": _moved(2)}, r"the body in pose 2 lies \d+ cm from scan 2"),
    ],
)
def test_what_cannot_be_is_refused(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=said):
        read_person(_file(tmp_path, **changed))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=r"no file of scans at .*nobody.npz"):
        read_person(tmp_path / "nobody.npz")
