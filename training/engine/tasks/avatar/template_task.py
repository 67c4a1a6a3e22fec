"""Learning the implicit template of an outfit: a frame a row, points around its scan, occupancy (FITE, section 3.2)."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial

import torch
from torch import Tensor, nn

from training.avatar.occupancy import FrameSamples
from training.avatar.outfit import OccupancySamples, Outfit
from training.avatar.template import near_surface_iou, template_loss
from training.data.cache_policy import Room
from training.engine.distributed import Ranks
from training.engine.tasks.avatar.frames import FrameFeed, FrameOrder, drawn
from training.engine.tasks.protocol import Validation
from training.networks.template import OccupancyTemplate
from training.recipes.networks import TemplateRecipe
from training.recipes.training import TrainingRecipe


@dataclass(frozen=True)
class OccupancyBatch:
    """Points around scans with a leading axis of frames, their poses [b, condition], and points around hands."""

    samples: FrameSamples
    condition: Tensor
    hands: tuple[Tensor, Tensor]

    def __len__(self) -> int:
        return len(self.condition)

    def in_dtype(self, dtype: torch.dtype) -> "OccupancyBatch":
        """The same with places and poses in another floating type."""
        points, inside = self.hands
        samples = self.samples._replace(roots=self.samples.roots.to(dtype))
        return replace(self, samples=samples, condition=self.condition.to(dtype), hands=(points.to(dtype), inside))

    def to(self, device: torch.device) -> "OccupancyBatch":
        """The same on another device."""
        samples, hands = FrameSamples(*(its.to(device) for its in self.samples)), [its.to(device) for its in self.hands]
        return OccupancyBatch(samples, self.condition.to(device), (hands[0], hands[1]))


class OccupancyObjective(nn.Module):
    """Cross entropy of occupancy (:func:`training.avatar.template.template_loss`)."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, batch: OccupancyBatch, *, step: int) -> dict[str, Tensor]:
        """Return the losses of a batch."""
        return {"total": template_loss(self.network, batch.samples, batch.condition, batch.hands)}


class TemplateTask:
    """See :class:`training.engine.tasks.protocol.Task`; ``outfit``: the folder of one, its points drawn."""

    def __init__(self, recipe: TrainingRecipe, outfit: Outfit) -> None:
        assert isinstance(recipe.network, TemplateRecipe)
        self._recipe, self._network, self._outfit = recipe, recipe.network, outfit
        self.url = str(outfit.path)
        self.uuid = self.sha256 = outfit.fingerprint(outfit.samples, outfit.field)

    @property
    def order(self) -> FrameOrder:
        """Of the seen frames."""
        return FrameOrder([self._samples.seen], batch=self._recipe.batch, seed=self._recipe.seed)

    @cached_property
    def _samples(self) -> OccupancySamples:
        return self._outfit.samples.load()

    def check(self, room: Room, ranks: int) -> None:
        """The order says whether there are frames enough; the network is small."""
        _ = self.order

    def network(self) -> nn.Module:
        """An occupancy network in the box of the outfit's field."""
        return template_network(self._network, self._outfit)

    def objective(self, network: nn.Module, device: torch.device) -> nn.Module:
        """See :class:`OccupancyObjective`."""
        return OccupancyObjective(network)

    @contextmanager
    def feed(self, ranks: Ranks, device: torch.device) -> Iterator[FrameFeed]:
        """Points around scans, in memory."""
        yield FrameFeed(self._recipe, self.order, ranks, partial(self._batch, device))

    def validation(self, device: torch.device, dtype: torch.dtype) -> "OccupancyValidation":
        """Measures intersection over union near the surfaces of scans."""
        return OccupancyValidation(self._samples, device, dtype)

    def _batch(self, device: torch.device, rows: list[tuple[int, int]], step: int, first: int) -> OccupancyBatch:
        """Frames with so many points around each scan."""
        own, seed, frames = self._samples, self._recipe.seed, [frame for _, frame in rows]
        points, inside = own.hands
        taken = [
            own.frame(frame, drawn(seed, step, place, of=own.count, count=self._network.points))
            for place, frame in enumerate(frames, first)
        ]
        if len(points):
            some = drawn(seed, step, _HANDS, of=len(points), count=self._network.hand_points)
            points, inside = points[some], inside[some]
        return OccupancyBatch(stacked(taken), own.conditions[frames], (points, inside)).to(device)


def stacked(frames: Sequence[FrameSamples]) -> FrameSamples:
    """Samples of several frames with a leading axis of these."""
    return FrameSamples(*(torch.stack(its) for its in zip(*frames, strict=True)))


_HANDS = 2**19  # a place that no frame has


class OccupancyValidation(Validation):
    """``evaluation/iou_seen`` and ``evaluation/iou_unseen``, over some frames; the latter decides."""

    decides = "evaluation/iou"
    _FRAMES = 4

    def __init__(self, samples: OccupancySamples, device: torch.device, dtype: torch.dtype) -> None:
        everything = torch.arange(samples.count).numpy()
        self._batches = {
            kind: OccupancyBatch(
                stacked([samples.frame(frame, everything) for frame in some]),
                samples.conditions[some],
                samples.hands,
            )
            .in_dtype(dtype)
            .to(device)
            for kind, frames in (("seen", samples.seen), ("unseen", samples.unseen))
            if (some := frames[: self._FRAMES])
        }

    def measure(self, network: nn.Module) -> dict[str, float]:
        """See the class."""
        return {
            f"{self.decides}_{kind}": near_surface_iou(network, batch.samples, batch.condition)
            for kind, batch in self._batches.items()
        }

    def decisive(self, metrics: dict[str, float]) -> float:
        """What is missing to a whole intersection."""
        return 1 - super().decisive(metrics) if metrics else 1.0


def template_network(recipe: TemplateRecipe, outfit: Outfit) -> OccupancyTemplate:
    """A new occupancy network in the box of an outfit's field."""
    field, samples = outfit.field.load(), outfit.samples.load()
    radius = float((field.high - field.low).max() / 2)
    centre = ((field.high + field.low) / 2).tolist()
    return OccupancyTemplate(centre=centre, radius=radius, condition=samples.conditions.shape[1], width=recipe.width)
