"""The point avatar of FITE: a person in clothes as points that are corrected, posed, and displaced by the pose.

Lin et al., "Learning Implicit Templates for Point-Based Clothed Human Modeling", ECCV 2022. The
points of an outfit lie on its canonical template and carry learned features g. With A the blend of the bones'
transforms at a point p, and R its left 3 x 3:

    corrected   c = 0.005 C(g)                 what the template lacks in every pose
    encoded     z = U_1 .. U_4                 four U-Nets over maps of posed positions, read where p is drawn
    displaced   r = 0.01 r', r', n' = D(z, g, p)
    posed       q = A (p + c) + R r,           normal R (m + n'), of length one, m the template's normal

C, U and D are shared by all outfits. Two departures: the weights blend transforms from the canonical pose, where the
released code composes two blends that differ where the canonical pose turns bones; and n' is added to the template's
normal, so that an untrained avatar already has that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, normalize

from training.networks.layers.pose_unet import PoseUNet, normalised

VIEWS = 4
"""Views that position maps are drawn in."""
_CORRECTION, _DISPLACEMENT = 0.005, 0.01  # metres for an output of one
_FEATURES = 0.01  # deviation of the points' features at first


class CanonicalPoints(NamedTuple):
    """The canonical points of an outfit, the vertices of its template.

    Attributes
    ----------
    points, normals
        ``[n, 3]``, in metres and of length one, in the canonical pose.
    weights
        Skinning weights ``[n, bone]``; those of a point sum to one.
    places
        Where each point is drawn in each view's map ``[view, n, 2]``: to the right and up, in [-1, 1].
    """

    points: Tensor
    normals: Tensor
    weights: Tensor
    places: Tensor


class Avatar(NamedTuple):
    """Posed points of some frames, one frame after another: ``[p, ...]``, p the sum of ``counts``.

    Attributes
    ----------
    points, normals
        ``[p, 3]``, in metres and of length one, in the pose.
    skinned
        Where the template alone would be, ``[p, 3]``.
    corrections
        ``[p, 3]`` in metres, in the canonical pose.
    displacements
        ``[p, 3]`` in metres, in the pose: ``points - displacements`` is the corrected template, skinned.
    features
        Of the points, ``[p, geometry]``.
    counts
        Points of each frame.
    """

    points: Tensor
    normals: Tensor
    skinned: Tensor
    corrections: Tensor
    displacements: Tensor
    features: Tensor
    counts: tuple[int, ...]


class PointAvatar(nn.Module):
    """The point avatar of several outfits; the defaults are the released sizes.

    Parameters
    ----------
    templates
        Of the outfits; they may differ in their number of points.
    map_size
        Pixels across a position map, a power of two from 16 on.
    unet_width
        Channels after the first level of a U-Net.
    hidden_width
        Channels of the decoder's hidden layers.
    geometry, pose
        Channels of a point's own features, and of its pose features over all four views.
    normalisation
        ``group``: nothing depends on the batch or the ranks; ``batch``: as released.

    Raises
    ------
    ValueError
        There is no template, shapes do not fit, or ``pose`` is no multiple of four.
    """

    points: Tensor
    normals: Tensor
    weights: Tensor
    places: Tensor

    def __init__(
        self,
        templates: Sequence[CanonicalPoints],
        *,
        map_size: int = 256,
        unet_width: int = 16,
        hidden_width: int = 256,
        geometry: int = 64,
        pose: int = 64,
        normalisation: str = "group",
    ) -> None:
        super().__init__()
        if pose % VIEWS:
            raise ValueError(f"pose must be a multiple of {VIEWS}, the number of views, got {pose}")
        _check_templates(templates)
        self.counts = tuple(len(template.points) for template in templates)
        for name in ("points", "normals", "weights"):
            self.register_buffer(name, torch.cat([getattr(template, name) for template in templates]).float())
        self.register_buffer("places", torch.cat([template.places for template in templates], dim=1).float())
        self.features = nn.Parameter(_FEATURES * torch.randn(sum(self.counts), geometry))
        self.correction = nn.Sequential(
            *(_hidden(geometry, geometry, normalisation) for _ in range(3)), nn.Linear(geometry, 3)
        )
        self.encoders = nn.ModuleList(
            PoseUNet(size=map_size, width=unet_width, channels=pose // VIEWS, normalisation=normalisation)
            for _ in range(VIEWS)
        )
        self.decoder = Decoder(pose + geometry + 3, hidden_width, normalisation)

    def forward(self, maps: Tensor, transforms: Tensor, outfits: Sequence[int]) -> Avatar:
        """Return the posed points of some frames.

        Parameters
        ----------
        maps
            Position maps ``[b, view, 3, size, size]`` (:class:`training.avatar.maps.PositionMaps`).
        transforms
            Of the bones ``[b, bone, 3, 4]``, from the canonical pose to the frame's.
        outfits
            Number [b] of the outfit that each frame shows.
        """
        rows = [self._rows(outfit) for outfit in outfits]
        points, features = (torch.cat([both[own] for own in rows]) for both in (self.points, self.features))
        encoded = torch.stack([encoder(maps[:, view]) for view, encoder in enumerate(self.encoders)], dim=1)
        read = torch.cat([read_maps(one, self.places[:, own]) for one, own in zip(encoded, rows, strict=True)])
        correction = _CORRECTION * self.correction(features)
        displacement, turn = self.decoder(torch.cat([read, features, points], dim=1))
        blended = torch.cat([blend(self.weights[own], one) for own, one in zip(rows, transforms, strict=True)])
        displacement = _DISPLACEMENT * _turned(blended, displacement)
        skinned = moved(blended, points)
        normals = _turned(blended, torch.cat([self.normals[own] for own in rows]) + turn)
        return Avatar(
            points=skinned + _turned(blended, correction) + displacement,
            normals=normalize(normals, dim=1),
            skinned=skinned,
            corrections=correction,
            displacements=displacement,
            features=features,
            counts=tuple(self.counts[outfit] for outfit in outfits),
        )

    def _rows(self, outfit: int) -> slice:
        """Which of all points are an outfit's."""
        first = sum(self.counts[:outfit])
        return slice(first, first + self.counts[outfit])


class Decoder(nn.Module):
    """What is known of points ``[p, given]`` to displacements and turns of normals, ``[p, 3]`` each."""

    def __init__(self, given: int, width: int, normalisation: str) -> None:
        super().__init__()
        self.first = nn.Sequential(
            _hidden(given, width, normalisation), *(_hidden(width, width, normalisation) for _ in range(3))
        )
        self.again = _hidden(given + width, width, normalisation)
        self.displacement, self.turn = (
            nn.Sequential(*(_hidden(width, width, normalisation) for _ in range(2)), nn.Linear(width, 3))
            for _ in range(2)
        )

    def forward(self, given: Tensor) -> tuple[Tensor, Tensor]:
        """Return both, without scale."""
        features = self.again(torch.cat([given, self.first(given)], dim=1))
        return self.displacement(features), self.turn(features)


def blend(weights: Tensor, transforms: Tensor) -> Tensor:
    """Return the blended transforms ``[n, 3, 4]`` of points with weights ``[n, bone]``, for ``[..., bone, 3, 4]``."""
    return (weights @ transforms.flatten(-2)).reshape(*transforms.shape[:-3], -1, 3, 4)


def moved(blended: Tensor, points: Tensor) -> Tensor:
    """Return points ``[n, 3]`` moved by the transforms ``[..., n, 3, 4]`` of each."""
    return _turned(blended, points) + blended[..., 3]


def read_maps(maps: Tensor, places: Tensor) -> Tensor:
    """Return what maps ``[view, c, h, w]`` say at places ``[view, n, 2]``: ``[n, view c]``, zero outside of a map."""
    at = places * places.new_tensor([1.0, -1.0])  # rows of a map run down
    read = grid_sample(maps, at[:, :, None], mode="bilinear", padding_mode="zeros", align_corners=False)
    return read[..., 0].permute(2, 0, 1).flatten(1)


def _turned(blended: Tensor, vectors: Tensor) -> Tensor:
    return (blended[..., :3] @ vectors[..., None])[..., 0]


def _hidden(before: int, after: int, normalisation: str) -> nn.Sequential:
    return nn.Sequential(nn.Linear(before, after), normalised(after, normalisation), nn.Softplus())


def _check_templates(templates: Sequence[CanonicalPoints]) -> None:
    if not templates:
        raise ValueError("an avatar needs a template: there is none")
    bones = templates[0].weights.shape[-1]
    for number, template in enumerate(templates):
        count = len(template.points)
        wanted = ((count, 3), (count, 3), (count, bones), (VIEWS, count, 2))
        for name, tensor, shape in zip(template._fields, template, wanted, strict=True):
            if tuple(tensor.shape) != shape:
                raise ValueError(f"template {number}: {name} must be {list(shape)}, got {list(tensor.shape)}")
