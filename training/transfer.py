"""Pose transfer for a person's own meshes: a mesh in the wanted pose and a mesh of the wanted identity in, one out."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from datagen.mesh import Mesh, bounding_box, check_mesh
from training.acceleration import GraphedTransfer, Precision
from training.inference import load_trained


class PoseTransfer:
    """A trained network with the normalisation around it.

    >>> transfer = PoseTransfer.from_run("runs/quickstart/run")        # doctest: +SKIP
    >>> posed = transfer(source=load_mesh("pose.obj"), target=load_mesh("person.obj"))    # doctest: +SKIP
    """

    def __init__(self, network: nn.Module, *, precision: Precision = "float32") -> None:
        """Use a network where it is; on a GPU shapes that come again are replayed (see :class:`GraphedTransfer`)."""
        self._transfer = GraphedTransfer(network.eval(), precision=precision)
        self._device = next((weight.device for weight in network.parameters()), torch.device("cpu"))

    @classmethod
    def from_run(cls, run: str | Path, *, device: torch.device | str | None = None) -> "PoseTransfer":
        """The network of a run folder, with the weights that are its result (CheckpointError where there are none).

        It runs on ``device``; by default on a GPU where there is one.
        """
        device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        return cls(load_trained(Path(run))[0].to(device))

    def __call__(self, *, source: Mesh, target: Mesh) -> Mesh:
        """The target's identity in the source's pose.

        Source and target may differ in vertices and faces, size and position; both must stand alike (Y up,
        facing +Z, as in the training data).

        Returns
        -------
        Mesh
            The target's faces, and its vertices moved, in the target's order; its box is centred where the target's
            was. Size: edges keep the length that they have in the target, on average (median over edges).
        """
        check_mesh(source, name="source")
        check_mesh(target, name="target")
        return self.pose(source.vertices, target)

    def pose(self, source: NDArray[np.floating], target: Mesh) -> Mesh:
        """As calling, from the source's vertices [n, 3] alone; meshes are taken to be usable."""
        return Mesh(_to_scale_of(target, self.vertices(source, target.vertices)), target.faces)

    @torch.no_grad()
    def vertices(self, source: NDArray[np.floating], target: NDArray[np.floating]) -> NDArray[np.float64]:
        """Posed vertices [n_target, 3] in the normalised box, from vertices [n_source, 3] and [n_target, 3]."""
        pair = [bounding_box(mesh).normalise(mesh).astype(np.float32)[None] for mesh in (source, target)]
        inputs = [torch.from_numpy(mesh).to(self._device) for mesh in pair]
        output = self._transfer(source=inputs[0], target=inputs[1])
        return output[0].double().cpu().numpy()


def _to_scale_of(target: Mesh, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Undo the normalisation: a pose changes the box, so the scale comes from edge lengths, which it hardly changes."""
    before, after = (_edge_lengths(each, target.faces) for each in (target.vertices, vertices))
    usable = after > 1e-9
    scale = float(np.median(before[usable] / after[usable])) if usable.any() else 1.0
    return (vertices - bounding_box(vertices).centre) * scale + bounding_box(target.vertices).centre


def _edge_lengths(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> NDArray[np.floating]:
    corners = vertices[faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).ravel()
