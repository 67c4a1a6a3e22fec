"""What networks are given of meshes: vertices in their boxes, and what is near along surfaces, where they take that.

A parts network poses the vertices of a mesh as they are, but reads rough ones, which have noise, through a low-pass
filter along the edges (:mod:`datagen.mesh.low_pass`). Outputs of people that are as finely meshed as their sources are
then compared with these through the same filter, so that what it does to a body is no difference. Filtered people, and
people of points, are read as their mirror images, too (animals' rigs are not alike on both sides). A source that lists
the vertices of its target in the same order is read at those at which the target is. A transfer reads its meshes so,
and what measures transfers of single meshes. Evaluations on datasets, whose bodies have no noise, do not; nor does what
asks how a mesh stands, whether it is a body, in which pose an avatar is to be, or onto which parts an output is
projected.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor, nn

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, bounding_box, edges_of
from datagen.mesh.low_pass import LowPass
from training.networks.layers.surface import Surface, joined, surface_of
from training.networks.parts import Parts, ReadTarget
from training.recipes.networks import PEOPLE

_ROUGH, _SLIGHT = 0.88, 0.004
"""Roughness above which a mesh is filtered, and by how much vertices must differ from their neighbours, half the box'
longest edge being 1: rounded coordinates do not matter (docs/results/parts-experiments.md).
"""
_WEAK = 2
"""How often animals and coarse meshes are filtered, of which more takes too much."""
_COARSE, _STEP, _LEAST, _MOST = 500, 600, 8, 64
"""Vertices up to which a mesh is coarse; for how many vertices a person is filtered once, and how often at least and at
most: the finer a mesh, the less a filter moves it.
"""
_ALIKE = 1.5
"""How many times as many vertices as the source a target may have, or the source as the target, where outputs are read
through a person's filter, too.
"""
_CORNERS_A_VERTEX = 3
"""How many corners of faces a vertex has at least, on average, where faces tell which vertices are listed: in triangle
soups one, in soups of quads one and a half, in large closed meshes about six. Of soups of small closed pieces it does
not tell.
"""
_NEIGHBOURS = 8
"""Of points, that are taken to be near them along the surface."""


def takes_surfaces(network: nn.Module) -> bool:
    """Whether a network is told what is near along the surfaces of its meshes (`training.networks.NETWORKS`)."""
    return bool(getattr(network, "takes_surfaces", False))


def surfaces_of(network: nn.Module, *, sources: Sequence[Mesh], targets: Sequence[Mesh]) -> dict[str, Surface]:
    """What a network takes beside the vertices of meshes: keyword arguments, none for the networks of the papers."""
    if not takes_surfaces(network):
        return {}
    device = device_of(network)
    return {
        "source_surface": surface_of_meshes(sources).to(device),
        "target_surface": surface_of_meshes(targets).to(device),
    }


def surface_of_meshes(meshes: Sequence[Mesh]) -> Surface:
    """What is near along the surfaces of meshes."""
    return joined([surface_of(mesh.vertices, _edges(mesh)) for mesh in meshes])


def has_points(mesh: Mesh) -> bool:
    """Whether some vertices have no face, so that what is near them is told by where they are."""
    return not _in_faces(mesh).all()


def lists_alike(one: Mesh, other: Mesh) -> bool:
    """Whether two meshes list the same vertices in the same order, as their faces tell.

    Not where most faces list vertices of their own, as unwelded ones do: 0, 1, 2, then 3, 4, 5, whatever these are.
    """
    alike = len(one.vertices) == len(other.vertices) and np.array_equal(one.faces, other.faces)
    return alike and np.size(one.faces) >= _CORNERS_A_VERTEX * len(one.vertices) and not has_points(one)


def device_of(network: nn.Module) -> torch.device:
    """Where a network's weights are."""
    return next((weight.device for weight in network.parameters()), torch.device("cpu"))


def normalised(vertices: Floats) -> NDArray[np.float32]:
    """Vertices [n, 3] in their normalised box, which is computed in float64."""
    exact = np.asarray(vertices, np.float64)
    return bounding_box(exact).normalise(exact).astype(np.float32)


def stacked(network: nn.Module, meshes: Sequence[Floats]) -> Tensor:
    """Vertices [n, 3] of some meshes, each in its normalised box, as a batch [b, n, 3] where the network is."""
    return torch.from_numpy(np.stack([normalised(vertices) for vertices in meshes])).to(device_of(network))


def transferred(network: nn.Module, sources: Sequence[Mesh], targets: Sequence[Mesh]) -> Tensor:
    """Return targets of n vertices each [b, n, 3] in the poses of sources of m vertices each, in boxes of their own."""
    if isinstance(network, Parts):
        return posed_targets(network, sources, targets, read_targets(network, targets))
    inputs = {name: stacked(network, [mesh.vertices for mesh in meshes])
              for name, meshes in (("source", sources), ("target", targets))}  # fmt: skip
    output: Tensor = network(**inputs, **surfaces_of(network, sources=sources, targets=targets))
    return output


@torch.inference_mode()
def read_targets(network: Parts, targets: Sequence[Mesh]) -> ReadTarget:
    """Return what a parts network reads off targets of as many vertices each."""
    boxes = [bounding_box(np.asarray(mesh.vertices, np.float64)) for mesh in targets]
    vertices = [_as_read(network, mesh)[0] for mesh in targets]
    read = [box.normalise(each).astype(np.float32) for box, each in zip(boxes, vertices, strict=True)]
    device = device_of(network)
    return network.read_target(
        stacked(network, [mesh.vertices for mesh in targets]),
        surface_of_meshes(targets).to(device),
        as_read=torch.from_numpy(np.stack(read)).to(device),
    )


@torch.inference_mode()
def posed_targets(
    network: Parts, sources: Sequence[Mesh], targets: Sequence[Mesh], read: ReadTarget, surface: Surface | None = None
) -> Tensor:
    """Return targets [b, n, 3] that were ``read``, in the poses of as many sources, in boxes of their own.

    Sources that list the target's vertices in its order are read at the same ones. ``surface``: of the sources, where
    it is known.
    """
    alike = torch.tensor([lists_alike(*both) for both in zip(sources, targets, strict=True)])
    if surface is None and not alike.all():
        surface = surface_of_meshes(sources).to(device_of(network))
    vertices, filtered = zip(*(_as_read(network, mesh) for mesh in sources), strict=True)
    through = [LowPass(target.faces, len(target.vertices)) if _is_heard(times, source, target) else None
               for times, source, target in zip(filtered, sources, targets, strict=True)]  # fmt: skip

    def heard(outputs: Tensor) -> Tensor:
        """Outputs [b, n, 3] as they are read, each as its source was."""
        rows = [output if low_pass is None
                else torch.from_numpy(normalised(low_pass(output.double().cpu().numpy(), times))).to(output)
                for low_pass, times, output in zip(through, filtered, outputs, strict=True)]  # fmt: skip
        return torch.stack(rows)

    of_people, of_points = network.joints == tuple(PEOPLE), torch.tensor([has_points(source) for source in sources])
    twice = of_people & (of_points | torch.tensor([times > 0 for times in filtered]))
    return network.posed_target(
        stacked(network, vertices),
        read,
        surface,
        heard=heard if any(through) else None,
        twice=twice.to(device_of(network)) if twice.any() else None,
        alike=alike if alike.any() else None,
    )


def _is_heard(times: int, source: Mesh, target: Mesh) -> bool:
    """Whether outputs are read through a source's filter, which does the same to both if they are as finely meshed."""
    few, many = sorted((len(source.vertices), len(target.vertices)))
    return times > _WEAK and many <= _ALIKE * few


def _as_read(network: Parts, mesh: Mesh) -> tuple[Floats, int]:
    """The vertices [n, 3] of a mesh, filtered if they are rough; and how often."""
    vertices = np.asarray(mesh.vertices, np.float64)
    low_pass = LowPass(mesh.faces, len(vertices))
    roughness, difference = low_pass.roughness(vertices)
    if roughness <= _ROUGH or difference <= _SLIGHT * bounding_box(vertices).half:
        return vertices, 0
    is_fine = network.joints == tuple(PEOPLE) and len(vertices) > _COARSE
    times = min(max(_LEAST, len(vertices) // _STEP), _MOST) if is_fine else _WEAK
    return low_pass(vertices, times), times


def _in_faces(mesh: Mesh) -> NDArray[np.bool_]:
    """Whether each vertex [n] has a face."""
    found = np.zeros(len(mesh.vertices), np.bool_)
    found[np.asarray(mesh.faces)] = True
    return found


def _edges(mesh: Mesh) -> NDArray[np.int64]:
    """Edges [e, 2] of a mesh; its points have some to the points that are nearest, none to vertices of faces."""
    edges, vertices = edges_of(mesh.faces), np.asarray(mesh.vertices, np.float64)
    points = np.flatnonzero(~_in_faces(mesh) & np.isfinite(vertices).all(axis=1))
    if len(points) < 2:
        return edges
    nearest = cKDTree(vertices[points]).query(vertices[points], min(_NEIGHBOURS + 1, len(points)))[1]
    between = np.stack([np.repeat(points, nearest.shape[1]), points[nearest.ravel()]], axis=1)
    return np.concatenate([edges, between])
