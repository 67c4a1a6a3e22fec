"""A transfer without a known truth is drawn and put on a page; files appear under their names."""

from pathlib import Path

import numpy as np
from matplotlib.image import imread

from training.viz.comparison_figure import comparison_figure
from training.viz.transfer_example import NamedMesh, shown
from training.viz.viewer import write_viewer

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 1.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def mesh(name: str, size: float = 1.0) -> NamedMesh:
    return NamedMesh(CORNERS * size, FACES, name)


def test_a_picture_has_a_row_for_each_frame(tmp_path: Path) -> None:
    row = shown(mesh("walk_1.obj", 100), mesh("a$b$.obj"), mesh("c.obj"))
    one, two = (imread(comparison_figure([row] * count, tmp_path / f"{count}.png")) for count in (1, 2))
    assert one.shape[1] == two.shape[1] and two.shape[0] > 1.6 * one.shape[0]
    for column in np.array_split(one[200:], 3, axis=1):
        assert column[..., :3].std() > 0.01, "every panel shows something"


def test_a_page_names_the_files(tmp_path: Path) -> None:
    row = shown(mesh("pose.obj"), mesh("person.obj"), mesh("posed.obj"))
    page = write_viewer([row], tmp_path / "p.html", title="Pose transfer")
    text = page.read_text()
    assert "person.obj in the pose of pose.obj" in text and "posed.obj" in text
