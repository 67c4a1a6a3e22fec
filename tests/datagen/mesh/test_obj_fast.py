"""Plain OBJ files: exact round trip, and nothing read that is not plain."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.mesh.formats.obj_fast import face_lines, read_plain, vertex_lines

PLAIN = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=3, max_size=30))
def test_every_float32_comes_back_bit_for_bit(numbers: list[float]) -> None:
    vertices = np.array(numbers[: len(numbers) // 3 * 3], np.float32).reshape(-1, 3)
    read = read_plain((vertex_lines(vertices) + face_lines(np.array([[0, 0, 0]]))).encode())
    assert read is not None
    assert read[0].astype(np.float32).tobytes() == vertices.tobytes()


def test_faces_count_from_one_in_the_file() -> None:
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    assert face_lines(faces) == "f 1 2 3\nf 3 2 4\n"
    read = read_plain((vertex_lines(np.eye(4, 3, dtype=np.float32)) + face_lines(faces)).encode())
    assert read is not None and np.array_equal(read[1], faces)


def test_comments_names_normals_and_line_ends_of_windows_are_no_matter() -> None:
    read = read_plain(b"# made by hand\r\nmtllib a.mtl\r\no it\r\ng all\r\nvn 0 0 1\r\n" + PLAIN.encode())
    assert read is not None and read[0].shape == (3, 3) and read[1].tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(
    "content",
    [
        "",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\n",
        PLAIN.replace("f 1 2 3", "f 1/1 2/2 3/3"),
        PLAIN.replace("f 1 2 3", "f -3 -2 -1"),
        PLAIN.replace("f 1 2 3", "f 1 2 3 1"),
        PLAIN.replace("f 1 2 3", "f 1 2"),
        PLAIN.replace("f 1 2 3", "f 1 \\\n2 3"),
        PLAIN.replace("v 1 0 0", "v 1 0 0 0.5 0.5 0.5"),
        PLAIN.replace("v 1 0 0", "v 1 zero 0"),
        PLAIN.replace("v 1 0 0", "v\t1 0 0"),
        PLAIN.replace("v 1 0 0", "  v 1 0 0"),
        PLAIN.replace("f 1 2 3", "f 0 1 2"),
    ],
)
def test_anything_else_is_left_to_the_general_reader(content: str) -> None:
    assert read_plain(content.encode()) is None
