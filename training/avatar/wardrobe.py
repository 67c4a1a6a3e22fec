"""The outfits of an avatar together: their templates, what the network is given of a pose, and the posed meshes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from datagen.common.arrays import Floats
from datagen.mesh.geometry import Mesh, vertex_normals
from datagen.mesh.low_pass import LowPassWhereTorn
from training.avatar.maps import PositionMaps, Views
from training.avatar.outfit import Outfit
from training.avatar.subject import Subject
from training.avatar.template import Template
from training.networks.avatar import Avatar, CanonicalPoints, PointAvatar
from training.objectives.point_losses import Edges
from training.recipes.networks import AvatarRecipe

_TORN, _TIMES = 1.5, 8
"""From where on, and how often, surfaces are low-passed; by seen poses (docs/results/avatar.md)."""
_OWN = 0.5
"""Of a surface's own normals beside those that are predicted; by seen poses."""


@dataclass(frozen=True, eq=False)
class Posed:
    """An avatar in a pose, in metres.

    Attributes
    ----------
    mesh
        Its surface (:meth:`Wardrobe.surface`).
    points, predicted
        Points [n, 3] and their normals as the network gives them.
    skinned, corrected
        The stages that lead to the points [n, 3].
    transforms
        Of the pose [bone, 3, 4], from the canonical one.
    """

    mesh: Mesh
    points: Floats
    predicted: Floats
    skinned: Floats
    corrected: Floats
    transforms: Floats

    @cached_property
    def normals(self) -> NDArray[np.float64]:
        """At the surface's vertices [n, 3], of length one: two parts as predicted, one as the surface has them.

        For loose clothes either alone is further from the scan's; for tight ones the surface's own are nearer
        (docs/results/avatar.md).
        """
        both = self.predicted + _OWN * vertex_normals(self.mesh.vertices, self.mesh.faces)
        return np.asarray(both / np.linalg.norm(both, axis=1, keepdims=True), np.float64)


@dataclass(frozen=True, eq=False)
class Wardrobe:
    """Subjects and templates by outfit, in one order.

    Parameters
    ----------
    subjects, templates
        Of the outfits.
    recipe
        Sizes of the network.
    """

    subjects: tuple[Subject, ...]
    templates: tuple[Template, ...]
    recipe: AvatarRecipe

    @classmethod
    def of(cls, outfits: Sequence[Outfit], recipe: AvatarRecipe) -> "Wardrobe":
        """Read the outfits' folders.

        Raises
        ------
        CheckpointError
            A file is missing or damaged.
        """
        return cls(tuple(its.subject.load() for its in outfits), tuple(its.template.load() for its in outfits), recipe)

    @cached_property
    def views(self) -> Views:
        """From which the templates are drawn."""
        return Views.of([its.vertices.double().numpy() for its in self.templates])

    @cached_property
    def _maps(self) -> tuple[PositionMaps, ...]:
        return tuple(
            PositionMaps(self.views, _mesh(its), its.weights, size=self.recipe.map_size) for its in self.templates
        )

    @cached_property
    def _smoothed(self) -> tuple[LowPassWhereTorn, ...]:
        return tuple(LowPassWhereTorn(_mesh(its), torn=_TORN) for its in self.templates)

    def surface(self, outfit: int, points: Floats) -> Mesh:
        """The surface of an outfit's points [n, 3] in a pose: smooth where they have come to lie in disorder.

        The points of a template that a pose tears, as at the hem of a skirt, jump to either side of the tear. There the
        surface is low-passed; elsewhere it is the points', as on most of the skin (not on fingers and feet that lie in
        disorder themselves). FITE's points have no faces: its released code makes a surface of them by Poisson's
        equation before it measures.
        """
        return Mesh(self._smoothed[outfit](points, _TIMES), self.templates[outfit].faces.numpy())

    def to(self, device: torch.device) -> "Wardrobe":
        """Move what makes maps to a device, in place, and return this."""
        for maps in self._maps:
            maps.to(device)
        return self

    def edges(self) -> list[Edges]:
        """Of the templates."""
        return [Edges.of(its.faces.numpy(), len(its.vertices)) for its in self.templates]

    def network(self) -> PointAvatar:
        """A new avatar of the templates' points."""
        points = []
        for template in self.templates:
            places = self.views.places(template.vertices.double().numpy())[..., :2]
            points.append(
                CanonicalPoints(template.vertices, template.normals, template.weights, torch.from_numpy(places).float())
            )
        return PointAvatar(points, **self.recipe.sizes())

    def given(self, rows: Sequence[tuple[int, int]]) -> tuple[Tensor, Tensor]:
        """Maps [b, view, 3, size, size] and transforms [b, bone, 3, 4] of rows (outfit, frame)."""
        return self.drawn([outfit for outfit, _ in rows], np.stack([self.subjects[o].transforms[f] for o, f in rows]))

    def drawn(self, outfits: Sequence[int], transforms: NDArray[np.floating]) -> tuple[Tensor, Tensor]:
        """Maps and transforms as :meth:`given`, for any transforms [b, bone, 3, 4] of each outfit's bones."""
        moved = torch.from_numpy(np.asarray(transforms, np.float32))
        moved = moved.to(self._maps[0].device)
        return torch.cat([self._maps[its](moved[row : row + 1]) for row, its in enumerate(outfits)]), moved

    def posed(
        self, network: nn.Module, rows: Sequence[tuple[int, int]], *, dtype: torch.dtype = torch.float32
    ) -> Iterator[Posed]:
        """The avatar in frames (outfit, frame), one after another."""
        for outfit, frame in rows:
            (found,) = self.animated(network, outfit, self.subjects[outfit].transforms[frame][None], dtype=dtype)
            yield found

    @torch.no_grad()
    def animated(
        self, network: nn.Module, outfit: int, transforms: NDArray[np.floating], *, dtype: torch.dtype = torch.float32
    ) -> Iterator[Posed]:
        """The avatar in an outfit, for each of some transforms [frame, bone, 3, 4] of its bones."""
        for moved in transforms:
            maps, its = self.drawn([outfit], moved[None])
            avatar: Avatar = network(maps.to(dtype), its.to(dtype), [outfit])
            points, normals, skinned, displaced = (
                each.double().cpu().numpy()
                for each in (avatar.points, avatar.normals, avatar.skinned, avatar.displacements)
            )
            yield Posed(self.surface(outfit, points), points, normals, skinned, points - displaced, moved)


def _mesh(template: Template) -> Mesh:
    return Mesh(template.vertices.double().numpy(), template.faces.numpy())
