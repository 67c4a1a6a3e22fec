"""Pose transfer for a person's own meshes: a mesh in the wanted pose and a mesh of the wanted identity in, one out.

Networks answer in a normalised box, people ask for the target's size and place.

Size: a pose changes the box, so the scale comes from edge lengths, which a pose hardly changes: their median ratio to
the target's. Place: the lowest vertex stays at the target's height and the middle of the box stays above the same spot
of the ground, so that a body that sits down sits on the ground on which it stood. Centring the box instead, as the
paper's normalisation suggests, would let it float at the height of its hips.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from datagen.common.arrays import Floats
from datagen.mesh.geometry import InFaces, Mesh, bounding_box, check_mesh, standing_point
from training.inference.mesh_reading import (
    device_of,
    lists_alike,
    posed_targets,
    read_targets,
    stacked,
    surface_of_meshes,
    takes_surfaces,
)
from training.inference.orientation import UPRIGHT, Axes
from training.inference.predict import load_trained
from training.inference.projection import OntoParts
from training.inference.standing import Standing, facing, misfit, rest_error, stands, understanding_of
from training.networks.execution import GraphedTransfer, products
from training.networks.layers.surface import Surface
from training.networks.parts import Parts
from training.objectives.metrics import point_mesh_distance

_VERTICES_AT_ONCE = 8192  # of self-transfers, so that memory stays bounded
REFINE_WEIGHT = 6.0
"""The least PMD and nearly the least edge error on the quickstart's unseen triples (docs/results/transfer.md)."""
Stands = Axes | Standing | None
_NO_LENGTH = 1e-9  # of the normalised box: an edge that has none says nothing of the scale


class PoseTransfer:
    """A trained network with the normalisation around it.

    >>> transfer = PoseTransfer.from_run("runs/quickstart/run")        # doctest: +SKIP
    >>> source, target = read_mesh_file("pose.obj"), read_mesh_file("person.obj")    # doctest: +SKIP
    >>> posed = transfer(source=source.mesh, target=target.mesh)    # doctest: +SKIP
    >>> write_posed(target, posed.vertices, Path("posed.obj"))      # doctest: +SKIP
    >>> for frame in transfer.sequence(walk, target.mesh, smooth=7): ...    # doctest: +SKIP
    """

    def __init__(self, network: nn.Module) -> None:
        """Use a network where it is.

        On a GPU shapes that come again are replayed (see :class:`GraphedTransfer`), but for networks that are told of
        surfaces.
        """
        self._transfer = GraphedTransfer(network.eval())
        self._bare, self._parts = self._transfer, network if isinstance(network, Parts) else None
        if isinstance(network, OntoParts):
            self._bare, self._parts = GraphedTransfer(network.network), network.parts
        self._network = network
        self._device = device_of(network)

    @classmethod
    def from_run(
        cls, run: str | Path, *, device: torch.device | str | None = None, project: Path | None = None
    ) -> "PoseTransfer":
        """The network of a run folder, with the weights that are its result (CheckpointError where there are none).

        It runs on ``device``; by default on a GPU where there is one. With ``project``, weights of a parts network, its
        outputs are projected onto rigid parts (:class:`training.inference.projection.OntoParts`).
        """
        device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        network = load_trained(Path(run))[0].to(device)
        return cls(OntoParts.of(network, project) if project else network)

    def __call__(
        self,
        *,
        source: Mesh,
        target: Mesh,
        source_axes: Stands = None,
        target_axes: Stands = None,
        refine: float = 0.0,
    ) -> Mesh:
        """The target's identity in the source's pose.

        Parameters
        ----------
        source, target
            Meshes that may differ in vertices, faces, size and position; the source may be points without faces.
            Vertices in no face are not read, where there are faces.
        source_axes, target_axes
            How each of them stands; by default as the network finds, where it can (`finds_standing`), else as the
            training data does, Y up and facing +Z.
        refine
            Weight of the target's edges in :class:`training.inference.refinement.Refinement`; 0 leaves the network's
            output.

        Returns
        -------
        Mesh
            The target's faces, and its vertices moved, in the target's order, axes and unit: edges keep the length that
            they have in the target (median over edges), and it stands where the target stands. Vertices in no face move
            as the nearest one does that is in some.

        Raises
        ------
        MeshError
            A mesh cannot be used; the message names which.
        """
        check_mesh(source, name="source", points=True)
        return next(self.sequence([source], target, source_axes=source_axes, target_axes=target_axes, refine=refine))

    def sequence(
        self,
        sources: Iterable[Mesh],
        target: Mesh,
        *,
        smooth: int = 0,
        refine: float = 0.0,
        source_axes: Stands = None,
        target_axes: Stands = None,
    ) -> Iterator[Mesh]:
        """Yield the target in the pose of each source, one after the other; memory holds one window of frames.

        Every source is normalised by its own box, as each was in training: with one box for all, a body that crouches
        or has walked away would be a small one in a corner, such as no network has seen. What the boxes take away, the
        way through space, is given back (:class:`RootTrajectory`).

        Parameters
        ----------
        sources
            Frames, evenly spaced in time; read as they are needed.
        target
            The identity; its own pose does not matter.
        smooth
            Frames of a Savitzky-Golay window along time (:mod:`training.inference.smoothing`); 0 smooths nothing.
        refine, source_axes, target_axes
            As calling.

        Raises
        ------
        MeshError
            While iterating: a mesh cannot be used.
        """
        whole, seen = target, InFaces.checked(target, name="target")
        target = seen.mesh
        target_axes = _as_told(target_axes) or self.standing(target)
        upright = Mesh(target_axes.turned(target.vertices), target.faces)
        frames = self._frames(sources, _as_told(source_axes), upright, target_axes)
        if smooth:
            from training.inference.smoothing import smoothed

            frames = smoothed(frames, smooth)
        refinement = None
        if refine:
            from training.inference.refinement import Refinement

            refinement = Refinement(upright, weight=refine)
        for vertices in frames:
            finished = refinement(vertices) if refinement else vertices
            yield Mesh(seen.of_all(target_axes.restored(finished)), whole.faces)

    def unplaced(self, source: Mesh, target: Mesh) -> NDArray[np.float64]:
        """Posed vertices [n_target, 3] in the normalised box, of meshes that are usable and stand upright."""
        return self._poser(target)(source)

    @torch.no_grad()
    def vertices(self, source: Floats, target: Floats, **surfaces: Surface) -> NDArray[np.float64]:
        """Posed vertices [n_target, 3] in the normalised box, from vertices [n_source, 3] and [n_target, 3].

        ``surfaces`` are what :func:`training.inference.mesh_reading.surfaces_of` says of the meshes.
        """
        meshes = (stacked(self._network, [mesh]) for mesh in (source, target))
        output = self._transfer(source=next(meshes), target=next(meshes), **surfaces)
        return output[0].double().cpu().numpy()

    def _poser(self, target: Mesh) -> Callable[[Mesh], NDArray[np.float64]]:
        """Return what poses the target as sources are, unplaced.

        What is read of the target alone, and what is near along the surface of sources that list the same vertices, is
        found once.
        """
        network = self._network
        if not isinstance(network, Parts):  # one whose outputs are projected reads the target's surface alone
            told = {"target_surface": surface_of_meshes([target]).to(self._device)} if takes_surfaces(network) else {}
            return lambda source: self.vertices(source.vertices, target.vertices, **told)
        with products("float32"):
            read = read_targets(network, [target])
        first: Mesh | None = None
        surface: Surface | None = None

        def posed(source: Mesh) -> NDArray[np.float64]:
            nonlocal first, surface
            if not lists_alike(source, target) and (first is None or not lists_alike(source, first)):
                first, surface = source, surface_of_meshes([source]).to(self._device)
            with products("float32"):
                return posed_targets(network, [source], [target], read, surface)[0].double().cpu().numpy()

        return posed

    @torch.no_grad()
    def self_errors(self, meshes: Floats) -> NDArray[np.float64]:
        """PMD [b] of meshes [b, n, 3] in the normalised box, each transferred onto itself."""
        at_once = max(1, _VERTICES_AT_ONCE // meshes.shape[1])
        parts = torch.split(torch.from_numpy(np.ascontiguousarray(meshes, np.float32)), at_once)
        itself = self._bare  # a projection would bring back nearly anything
        found = [point_mesh_distance(itself(source=p, target=p), p) for p in (q.to(self._device) for q in parts)]
        return torch.cat(found).double().cpu().numpy()

    @property
    def finds_standing(self) -> bool:
        """Whether the network says how well it understands a mesh, so that meshes are turned without being asked."""
        return isinstance(self._network, Parts)

    def standing(self, mesh: Mesh) -> Axes | Standing:
        """How a mesh stands, where the network can say; else as the training data."""
        return stands(self._network, mesh) if isinstance(self._network, Parts) else UPRIGHT

    def misfit(self, vertices: Floats) -> float:
        """How badly the parts network, or that which projects, understands a mesh [n, 3] that stands upright."""
        assert self._parts is not None
        return misfit(understanding_of(self._parts), vertices)

    def rest_error(self, mesh: Mesh) -> float:
        """By how many degrees the parts network, or that which projects, misreads a mesh that stands upright."""
        assert self._parts is not None
        return rest_error(self._parts, mesh)

    def _turned_round(self, vertices: Floats, before: NDArray[np.float64] | Axes | Standing) -> NDArray[np.float64]:
        """The turn [3, 3] of a body from upright, facing +Z, if the network can say (`facing`)."""
        if isinstance(self._network, Parts):
            before = before.lean if isinstance(before, Axes) else before
            return facing(understanding_of(self._network), vertices, before)
        return before if isinstance(before, np.ndarray) else before.lean

    def _frames(
        self, sources: Iterable[Mesh], axes: Stands, target: Mesh, target_axes: Axes | Standing
    ) -> Iterator[Floats]:
        """Placed vertices [n_target, 3] of each frame, Y up; the target leans, but for what is found here."""
        trajectory: RootTrajectory | None = None
        turn = np.eye(3)
        own = target.vertices @ self._turned_round(target.vertices, target_axes)  # its lean is of its pose, and goes
        posed = self._poser(Mesh(own, target.faces))
        for number, source in enumerate(sources):
            mesh = InFaces.checked(source, name=f"source {number}", points=True).mesh
            if number == 0:  # the others may turn round and bend
                axes = axes or self.standing(mesh)
            assert axes is not None
            vertices = axes.turned(mesh.vertices)
            turn = self._turned_round(vertices, turn if number else axes)
            read = vertices @ turn
            output = posed(Mesh(read, mesh.faces)) @ turn.T
            scale = scale_of(target, output)
            trajectory = trajectory or RootTrajectory(standing_point(vertices), scale / float(bounding_box(read).half))
            yield placed(target, scale * output) + trajectory.offset(vertices)


def _as_told(axes: Stands) -> Stands:
    """How a mesh stands without what was read of a root, which may have been another mesh's."""
    return replace(axes, root=None) if isinstance(axes, Standing) else axes


@dataclass(frozen=True)
class RootTrajectory:
    """The way that the frames of a sequence go over and above the ground, in the units of the target.

    A frame's box holds no place, so a walk would be a walk on the spot. The output goes where the source goes, with
    steps as long as its own size asks for. The ratio is that of the first frame, lest it tremble.

    Attributes
    ----------
    start
        Where the first frame stands [3], in the source's units.
    ratio
        Units of the target for one of the source.
    """

    start: Floats
    ratio: float

    def offset(self, source: Floats) -> Floats:
        """Return how far [3] the output of this frame is from where the first one stands."""
        return (standing_point(source) - self.start) * self.ratio


def scale_of(target: Mesh, vertices: Floats) -> float:
    """Return how many units of the target one unit of the output's box is; vertices [n, 3] in the normalised box."""
    before, after = (_side_lengths(each, target.faces) for each in (target.vertices, vertices))
    usable = (after > _NO_LENGTH) & (before > 0)
    return float(np.median(before[usable] / after[usable])) if usable.any() else 1.0


def placed(target: Mesh, vertices: Floats) -> Floats:
    """Vertices [n, 3] of the target's size -> where the target stands; all with Y up."""
    return vertices - standing_point(vertices) + standing_point(target.vertices)


def _side_lengths(vertices: Floats, faces: NDArray[np.integer]) -> Floats:
    corners = vertices[faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).ravel()
