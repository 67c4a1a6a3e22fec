"""What a person looks at after a transfer: source, target and output side by side."""

from dataclasses import dataclass

from datagen.mesh.geometry import Mesh
from training.viz.look import Look
from training.viz.transfer_example import Comparison, Motion

PANEL = (480, 560)
"""Pixels of a panel of its picture."""


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
