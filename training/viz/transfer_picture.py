"""What a person looks at after a transfer: source, target and output side by side, as a picture and as a page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from datagen.mesh.geometry import Mesh
from training.viz.comparison_figure import comparison_figure
from training.viz.look import Look
from training.viz.transfer_example import Comparison, Motion
from training.viz.viewer import write_viewer

PANEL = (480, 560)


@dataclass(frozen=True)
class NamedMesh(Mesh):
    """A mesh, Y up and facing +Z, what the page calls it, and what its faces look like in its file."""

    name: str
    look: Look | None = None


def shown(
    source: NamedMesh, target: NamedMesh, output: NamedMesh, *, motion: Motion | None = None, title: str = ""
) -> Comparison:
    """One transfer without a known truth, as figures and viewer take it; ``motion``: the frames that it begins."""
    title = title or f"{target.name} in the pose of {source.name}"
    return Comparison(title=title, source=source, target=target, outputs={"Output": output}, motion=motion)


def write_picture(rows: Sequence[Comparison], path: Path, *, panel: tuple[int, int] = PANEL) -> Path:
    """Draw transfers as a PNG, one a row of panels [width, height] in pixels; it appears whole or not at all."""
    return comparison_figure(rows, path, panel=panel)


def write_page(rows: Sequence[Comparison], path: Path) -> Path:
    """Write a page (HTML) in which transfers can be turned; it appears whole or not at all."""
    return write_viewer(rows, path, title="Pose transfer")
