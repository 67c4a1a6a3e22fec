"""Learning the points of outfits: a frame a row, posed points against the scan's surface (FITE, section 3.3)."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from training.avatar.outfit import Outfit, SurfaceSamples
from training.avatar.wardrobe import Wardrobe
from training.data.cache_policy import Room
from training.engine.distributed import Ranks, agreed
from training.engine.tasks.avatar.frames import FrameFeed, FrameOrder, drawn
from training.engine.tasks.protocol import Validation
from training.objectives.point_losses import Edges, Scan, avatar_loss, nearest
from training.recipes.networks import AvatarRecipe
from training.recipes.training import TrainingRecipe

_QUIET = 1e-6  # weight of normals before they count


@dataclass(frozen=True)
class FrameBatch:
    """Position maps [b, view, 3, size, size], transforms [b, bone, 3, 4] and outfits [b] of frames, and their scans."""

    maps: Tensor
    transforms: Tensor
    outfits: tuple[int, ...]
    scans: tuple[Scan, ...]

    def __len__(self) -> int:
        return len(self.outfits)

    def in_dtype(self, dtype: torch.dtype) -> "FrameBatch":
        """The same in another floating type."""
        scans = tuple(Scan(*(its.to(dtype) for its in scan)) for scan in self.scans)
        return replace(self, maps=self.maps.to(dtype), transforms=self.transforms.to(dtype), scans=scans)


class AvatarObjective(nn.Module):
    """:func:`training.objectives.point_losses.avatar_loss`; normals count from a step on."""

    def __init__(self, network: nn.Module, normals_from: float, edges: Sequence[Edges], roughness: float) -> None:
        super().__init__()
        self.network, self._normals_from, self._edges, self._roughness = network, normals_from, edges, roughness

    def forward(self, batch: FrameBatch, *, step: int) -> dict[str, Tensor]:
        """Return the losses of a batch."""
        avatar = self.network(batch.maps, batch.transforms, batch.outfits)
        normals = 1.0 if step >= self._normals_from else _QUIET
        edges = [self._edges[outfit] for outfit in batch.outfits]
        loss, parts = avatar_loss(avatar, batch.scans, normals=normals, edges=edges, roughness=self._roughness)
        return {**parts, "total": loss}


class AvatarTask:
    """See :class:`training.engine.tasks.protocol.Task`; ``outfits``: folders of outfits with templates."""

    def __init__(self, recipe: TrainingRecipe, outfits: Sequence[Outfit], url: str) -> None:
        assert isinstance(recipe.network, AvatarRecipe)
        self._recipe, self._network, self._outfits = recipe, recipe.network, outfits
        self.url = url
        files = [file for its in outfits for file in (its.subject, its.template, its.surfaces)]
        self.uuid = self.sha256 = Outfit.fingerprint(*files)
        self._wardrobe = Wardrobe.of(outfits, self._network)

    @property
    def order(self) -> FrameOrder:
        """Of the seen frames of all outfits."""
        frames = [subject.seen for subject in self._wardrobe.subjects]
        return FrameOrder(frames, batch=self._recipe.batch, seed=self._recipe.seed)

    def check(self, room: Room, ranks: int) -> None:
        """The order says whether there are frames enough."""
        _ = self.order

    def network(self) -> nn.Module:
        """Points on the outfits' templates."""
        return self._wardrobe.network()

    def objective(self, network: nn.Module, device: torch.device) -> nn.Module:
        """See :class:`AvatarObjective`."""
        steps = self._recipe.last_step(self.order.steps_per_epoch)
        edges = [its.to(device) for its in self._wardrobe.edges()]
        return AvatarObjective(network, self._network.normals_from * steps, edges, self._network.roughness)

    @contextmanager
    def feed(self, ranks: Ranks, device: torch.device) -> Iterator[FrameFeed]:
        """Scans' points, in memory."""
        yield agreed(ranks, lambda: self._feed(ranks, device), what="read the scans")

    def _feed(self, ranks: Ranks, device: torch.device) -> FrameFeed:
        self._wardrobe.to(device)
        surfaces = [its.surfaces.load() for its in self._outfits]
        return FrameFeed(self._recipe, self.order, ranks, partial(self._batch, surfaces, device))

    def validation(self, device: torch.device, dtype: torch.dtype) -> "AvatarValidation":
        """Measures how far the avatar is from scans."""
        return AvatarValidation(self._wardrobe, self._outfits, device, dtype)

    def _batch(
        self,
        surfaces: Sequence[SurfaceSamples],
        device: torch.device,
        rows: list[tuple[int, int]],
        step: int,
        first: int,
    ) -> FrameBatch:
        """Frames with so many points of each scan."""
        maps, transforms = self._wardrobe.given(rows)
        scans = []
        for place, (outfit, frame) in enumerate(rows, first):
            points, normals = surfaces[outfit].points[frame], surfaces[outfit].normals[frame]
            count = min(self._network.scan_points, len(points))
            some = drawn(self._recipe.seed, step, place, of=len(points), count=count)
            scans.append(Scan(points[some].to(device), normals[some].to(device)))
        return FrameBatch(maps, transforms, tuple(outfit for outfit, _ in rows), tuple(scans))


class AvatarValidation(Validation):
    """``evaluation/plane_seen``, ``plane_unseen``: mm of surfaces from the scans' planes; the latter decides."""

    decides = "evaluation/plane"
    _FRAMES = 4

    def __init__(self, wardrobe: Wardrobe, outfits: Sequence[Outfit], device: torch.device, dtype: torch.dtype) -> None:
        self._wardrobe, self._dtype = wardrobe.to(device), dtype
        self._surfaces = [its.surfaces.load() for its in outfits]

    def measure(self, network: nn.Module) -> dict[str, float]:
        """See the class."""
        found = {kind: self._plane(network, kind) for kind in ("seen", "unseen")}
        return {f"{self.decides}_{kind}": value for kind, value in found.items() if value is not None}

    def _plane(self, network: nn.Module, kind: str) -> float | None:
        rows = [
            (number, frame)
            for number, subject in enumerate(self._wardrobe.subjects)
            for frame in getattr(subject, kind)[: self._FRAMES]
        ]
        posed = self._wardrobe.posed(network, rows, dtype=self._dtype)
        found = [self._of(row, torch.from_numpy(its.mesh.vertices)) for row, its in zip(rows, posed, strict=True)]
        return float(np.mean(found)) if found else None

    def _of(self, row: tuple[int, int], points: Tensor) -> float:
        outfit, frame = row
        samples = self._surfaces[outfit]
        surface, normals = samples.points[frame].double(), samples.normals[frame].double()
        near = nearest(points, surface)
        return 1000 * float(((surface[near] - points) * normals[near]).sum(dim=1).abs().mean())
