"""Every tricky file of tests/golden/meshes is read as facts.json has it, every broken one refused in one line."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.common.errors import MeshError
from datagen.mesh.files import load_mesh, read_mesh_file
from tests.support.shapes.mesh_files import GOLDEN

FACTS: dict[str, dict[str, Any]] = json.loads((GOLDEN / "facts.json").read_text())
BROKEN: list[tuple[str, str, str]] = json.loads((GOLDEN / "broken.json").read_text())
"""What is said, the file's name, and its bytes as Latin-1."""


@pytest.mark.parametrize("name", FACTS)
def test_a_file_is_read_as_it_is(name: str) -> None:
    read, facts = read_mesh_file(GOLDEN / name), FACTS[name]
    surface = read.content.surface
    assert np.allclose(read.mesh.vertices, facts["vertices"], atol=1e-6)
    assert read.mesh.faces.tolist() == facts["faces"] and surface.sizes.tolist() == facts["corners"]
    assert read.name == facts["name"] and read.content.only_here == facts["only_here"]
    assert [each.name for each in surface.materials] == facts["materials"]
    alone = load_mesh(GOLDEN / name)
    assert np.array_equal(alone.vertices, read.mesh.vertices) and np.array_equal(alone.faces, read.mesh.faces)


@pytest.mark.parametrize(("message", "name", "content"), BROKEN, ids=[f"{n} {m}"[:40] for m, n, _ in BROKEN])
def test_a_broken_file_is_refused_in_one_line(tmp_path: Path, message: str, name: str, content: str) -> None:
    (tmp_path / name).write_bytes(content.encode("latin-1"))
    with pytest.raises(MeshError) as caught:
        read_mesh_file(tmp_path / name)
    assert re.search(message, str(caught.value)) and str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)
