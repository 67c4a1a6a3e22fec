"""The typed recipes of training and evaluation; the networks' are in :mod:`training.recipes.networks`."""

import re
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from datagen.common.errors import RecipeError
from datagen.recipe import Frozen
from training.recipes.networks import (
    AvatarRecipe,
    DsffnetRecipe,
    NetworkRecipe,
    NptRecipe,
    PartsRecipe,
    TemplateRecipe,
)

ONE_CYCLE_WARM_UP = 0.1
"""Fraction of the steps that a one-cycle schedule rises in, where the recipe says none."""

_BUDGET = re.compile(r"(\d+(?:\.\d+)?)\s*(s|min|h)")
_SECONDS = {"s": 1, "min": 60, "h": 3600}
_BLOCK = re.compile(r"(\d+(?:\.\d+)?)\s*(kB|MB|GB|TB)")
_BYTES = {"kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}


def budget_seconds(budget: str) -> float:
    """Seconds of a time budget such as ``90s``, ``10min`` or ``2.5h``.

    Raises
    ------
    ValueError
        It is not of that form.
    """
    found = _BUDGET.fullmatch(budget.strip())
    if found is None or float(found[1]) == 0:
        raise ValueError(f"budget {budget!r} is not a time such as 90s, 10min or 2.5h")
    return float(found[1]) * _SECONDS[found[2]]


def _is_time(budget: object) -> object:
    budget_seconds(str(budget))
    return budget


def block_bytes(block: str) -> int:
    """Bytes of a block such as ``500MB`` or ``16GB``.

    Raises
    ------
    ValueError
        It is not of that form.
    """
    found = _BLOCK.fullmatch(block.strip())
    if found is None:
        raise ValueError(f"block {block!r} is not a size such as 500MB or 16GB")
    return int(float(found[1]) * _BYTES[found[2]])


def _is_size(block: object) -> object:
    block_bytes(str(block))
    return block


class ScheduleRecipe(Frozen):
    """Learning rate over the run, as a factor of ``learning_rate``."""

    name: Literal["step", "one_cycle", "cosine", "linear", "constant"] = Field(
        "step",
        description="step: times ``decay`` every ``decay_epochs``; one_cycle: cosine up, cosine down to zero; "
        "cosine: linear warm-up, cosine down to zero; linear: warm-up, held, linearly to zero; constant: warm-up, held",
    )
    decay: float = Field(0.8, gt=0, le=1, description="step: factor (paper: 0.8)")
    decay_epochs: int = Field(8, ge=1, description="step: epochs between decays (paper: 8)")
    warm_up: float | None = Field(
        None, ge=0, lt=1, description="fraction of the steps spent rising; default: one_cycle 0.1, others 0"
    )
    hold: float = Field(0.5, ge=0, le=1, description="linear: fraction of the steps before it falls (3D-CoreNet: 0.5)")

    @property
    def rise(self) -> float:
        """The fraction of the steps in which the learning rate rises, where none is given too."""
        if self.warm_up is None:
            return ONE_CYCLE_WARM_UP if self.name == "one_cycle" else 0.0
        return self.warm_up

    @model_validator(mode="after")
    def _rises_before_it_falls(self) -> "ScheduleRecipe":
        if self.name == "linear" and (self.warm_up or 0) > self.hold:
            raise ValueError(
                f"warm_up {self.warm_up} is more than hold {self.hold}: set hold to {self.warm_up} or more"
            )
        return self


class AugmentationRecipe(Frozen):
    """Random changes of a training batch, drawn from (seed, step, place in the batch). The paper has none."""

    vertices: float = Field(
        1.0, gt=0, le=1, description="fraction of the source's vertices that the network sees, another subset each time"
    )
    source_holes: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="largest share of the source's vertices that is cut out around one of them, another each time, "
        "small ones more often",
    )
    source_noise: float = Field(
        0.0,
        ge=0,
        le=0.5,
        description="largest standard deviation of noise on source vertices, half the longest box edge = 1; another "
        "each time, small ones more often",
    )
    subset: int | None = Field(
        None,
        ge=8,
        description="vertices of source and of target that a step takes, others each time (edges of the loss are drawn "
        "with them); a step's time falls with them. Network parts: of meshes of more than 1,024 vertices by area",
    )
    turn: float = Field(
        0.0,
        ge=0,
        le=180,
        description="degrees that source and target are turned about the vertical at most, each its own",
    )
    lean: float = Field(
        0.0,
        ge=0,
        le=90,
        description="degrees that source and target are tilted at most, to any side, each its own; small tilts more "
        "often",
    )
    proportions: float = Field(
        0.0,
        ge=0,
        le=1,
        description="network parts: standard deviation of the logarithm of the factors by which the bodies' parts are "
        "made larger or smaller, in half of the triples, by chance",
    )
    points: float = Field(
        0.0,
        ge=0,
        le=1,
        description="network parts: share of the sources, and of the targets, that are made of random points of their "
        "surfaces, even by area of the body at rest, in the place of vertices",
    )
    at_rest: bool = Field(
        False,
        description="network parts: every mesh is given once more as its reading poses it to rest, where transfers "
        "read it again; a step takes twice as long",
    )
    recombined: float = Field(
        0.0,
        ge=0,
        le=1,
        description="share of the triples whose bodies are posed anew by the dataset's rigs, each joint turned as in a "
        "pose of its own (joints that turn alike in all poses as in one); what rigs do not describe is left out, as "
        "draped cloth",
    )
    shuffle: bool = Field(
        False,
        description="the network sees the target's vertices in another order at each step (3D-CoreNet's authors do, "
        "as its generator reads neighbours in the list); changes nothing for DSFFNet and NPT",
    )


class TrainingRecipe(Frozen):
    """How a network is trained; the defaults are the DSFFNet paper's (section 4.2)."""

    network: NetworkRecipe = Field(default_factory=DsffnetRecipe)
    start_from: str | None = Field(None, description="run or weights to begin from (fine-tuning); any dataset")
    reconstruction_weight: float = Field(1.0, gt=0, description="weight of the reconstruction loss")
    edge_weight: float = Field(0.0005, ge=0, description="lambda of the edge-length loss (0: ablation w/o L_edge)")
    edge_reference: Literal["truth", "target"] = Field(
        "truth", description="mesh whose edge lengths count as right; target: NPT, released DSFFNet"
    )
    edge_measure: Literal["length", "squared_length"] = Field(
        "length",
        description="what the ratio is of; squared_length: released DSFFNet (biased: 0.23 at a perfect output)",
    )
    edge_sum: Literal["edges", "faces"] = Field(
        "edges", description="mean over edges; faces: mean over faces of the sum of their three edges (NPT)"
    )
    batch: int = Field(8, ge=1, description="triples in a step, over all ranks together")
    accumulate: int = Field(1, ge=1, description="parts that a rank's share of a batch is cut into, to save memory")
    epochs: int = Field(200, ge=1, description="epochs; one epoch is identities x poses triples")
    steps: int | None = Field(None, ge=1, description="stop after this many steps instead; the schedule spans them")
    budget: Annotated[str, BeforeValidator(_is_time)] | None = Field(
        None, description="time after which one command stops with a checkpoint, e.g. 10min; run it again to resume"
    )
    optimiser: Literal["adamw", "adam", "muon"] = Field(
        "adamw", description="AdamW, Adam (NPT, 3D-CoreNet), or Muon for the matrices and AdamW for all else"
    )
    betas: tuple[Annotated[float, Field(ge=0, lt=1)], Annotated[float, Field(ge=0, lt=1)]] = Field(
        (0.9, 0.999), description="of the optimiser's running means"
    )
    epsilon: float = Field(1e-8, gt=0, description="of the optimiser's denominator")
    learning_rate: float = Field(1e-3, gt=0, description="highest learning rate")
    weight_decay: float = Field(0.01, ge=0, description="weight decay")
    gradient_clip: float | None = Field(None, gt=0, description="largest gradient norm")
    schedule: ScheduleRecipe = Field(default_factory=ScheduleRecipe)
    average: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="decay of an exponential moving average of the weights (EMA), which is then evaluated",
    )
    early_stopping: int | None = Field(
        None,
        ge=1,
        description="evaluations without a better measure (of transfer: PMD on unseen poses) after which training ends",
    )
    augmentation: AugmentationRecipe = Field(default_factory=AugmentationRecipe)
    seed: int = Field(0, ge=0, description="seed of the weights and of the order of triples")
    ranks: int = Field(1, ge=1, description="processes that train together (DDP)")
    fewest_ranks: int | None = Field(
        None,
        ge=1,
        description="launcher ray: continue with so few when nodes are lost (elastic); default: as many as ranks",
    )
    launcher: Literal["auto", "ray", "inline"] = Field(
        "auto",
        description="ray: Ray Train; inline: this process, one rank; auto: inline for one rank, but on a cluster ray",
    )
    precision: Literal["float32", "tf32", "bfloat16", "float64"] = Field(
        "float32",
        description="of the wide matrix products; norms, losses and weights stay float32; float64: all, for checks",
    )
    compile: bool = Field(False, description="torch.compile the network: a minute at first, then faster on a GPU")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="auto: CUDA where there is one")
    cache: Literal["auto", "device", "stream"] = Field(
        "auto",
        description="where decoded meshes are kept: device: all in the memory of the device that trains; stream: as "
        "many as memory has room for; auto: device where they fit",
    )
    block: Annotated[str, BeforeValidator(_is_size)] | None = Field(
        None,
        description="for data larger than memory: triples come in blocks of shards that take so much memory, all ranks "
        "together (of each rank, where a block is too small to share), e.g. 16GB, and each shard is read about once an "
        "epoch; in each rank the order takes 32 bytes a cell (identity and pose) on top, and 100 where epochs begin; "
        "default: shuffled over the whole grid",
    )
    log_every: int = Field(20, ge=1, description="steps between lines of metrics.jsonl")
    evaluate_every: int = Field(500, ge=1, description="steps between measurements on a fixed evaluation subset")
    evaluate_triples: int = Field(32, ge=1, description="triples of each pose type in that subset")
    picture_every: int | None = Field(None, ge=1, description="steps between pictures of a few fixed transfers")
    checkpoint_every: int = Field(500, ge=1, description="steps between checkpoints")
    keep_checkpoints: int = Field(2, ge=1, description="newest checkpoints that are kept, beside the best")
    timeout: int = Field(
        300, ge=10, le=604_800, description="seconds after which a rank gives up waiting for the others"
    )

    @model_validator(mode="after")
    def _consistent(self) -> "TrainingRecipe":
        parts = f" in {self.accumulate} parts each" if self.accumulate > 1 else ""
        if self.batch < self.ranks * self.accumulate:
            raise ValueError(f"batch {self.batch} is too small to be shared by {self.ranks} ranks{parts}")
        if self.batch % (self.ranks * self.accumulate) and self.fewest_ranks is None:  # elastic: any share is right
            raise ValueError(f"batch {self.batch} cannot be shared equally by {self.ranks} ranks{parts}")
        if self.launcher == "inline" and self.ranks > 1:
            raise ValueError(f"launcher 'inline' is one process, but ranks is {self.ranks}; use launcher 'ray'")
        if self.fewest_ranks and self.fewest_ranks > self.ranks:
            raise ValueError(f"fewest_ranks {self.fewest_ranks} is more than ranks {self.ranks}")
        return self

    @model_validator(mode="after")
    def _can_be_meant(self) -> "TrainingRecipe":
        kept, subset = self.augmentation.vertices, self.augmentation.subset
        thinned = {
            f"vertices {kept}": ("vertices to 1", kept < 1),
            f"subset {subset}": ("subset to null", subset is not None),
            f"source_holes {self.augmentation.source_holes}": ("source_holes to 0", self.augmentation.source_holes > 0),
        }
        found = next(((field, whole) for field, (whole, is_set) in thinned.items() if is_set), None)
        if isinstance(self.network, NptRecipe) and self.network.variant == "origin" and found:
            field, whole = found
            raise ValueError(
                f"network.variant 'origin' pairs source and target by index, but augmentation.{field} "
                f"leaves vertices out: set augmentation.{whole}, or network.variant to maxpool"
            )
        if isinstance(self.network, NptRecipe) and self.network.variant == "origin" and self.augmentation.shuffle:
            raise ValueError(
                "network.variant 'origin' pairs source and target by index, but augmentation.shuffle is true: "
                "set augmentation.shuffle to false, or network.variant to maxpool"
            )
        if subset and kept < 1:
            raise ValueError("augmentation.subset and augmentation.vertices both leave vertices out: take one away")
        for name in ("proportions", "points", "at_rest"):
            if getattr(self.augmentation, name) and not isinstance(self.network, PartsRecipe):
                raise ValueError(
                    f"augmentation.{name} needs the rigs that network 'parts' is told of, but the network is "
                    f"{self.network.name!r}: set augmentation.{name} to {'false' if name == 'at_rest' else 0}"
                )
        self._refuse_what_parts_does_not_know()
        self._refuse_what_avatars_do_not_know()
        if self.early_stopping and self.steps and self.evaluate_every >= self.steps:
            raise ValueError(
                f"early_stopping {self.early_stopping} goes by evaluations, but with evaluate_every "
                f"{self.evaluate_every} there is none before the last of {self.steps} steps: "
                "set evaluate_every lower, or early_stopping to null"
            )
        return self

    def _refuse_what_parts_does_not_know(self) -> None:
        if not isinstance(self.network, PartsRecipe):
            return
        if self.augmentation.subset is None:
            raise ValueError("network 'parts' learns from subsets of vertices: set augmentation.subset, e.g. to 256")
        unknown = {
            "precision": self.precision not in ("float32", "float64"),
            "compile": self.compile,
            "augmentation.shuffle": self.augmentation.shuffle,
        }
        for field, is_set in unknown.items():
            if is_set:
                raise ValueError(f"network 'parts' knows no {field}: take it away")

    def _refuse_what_avatars_do_not_know(self) -> None:
        if not isinstance(self.network, TemplateRecipe | AvatarRecipe):
            return
        unknown = {
            "precision": self.precision not in ("float32", "float64"),
            "compile": self.compile,
            "augmentation": self.augmentation != AugmentationRecipe(),
            "block": self.block is not None,
        }
        for field, is_set in unknown.items():
            if is_set:
                raise ValueError(f"network {self.network.name!r} knows no {field}: take it away")
        if isinstance(self.network, AvatarRecipe) and self.network.features_rate != 1 and self.optimiser == "muon":
            raise ValueError("optimiser 'muon' knows no network.features_rate: take it away, or use adam")
        if isinstance(self.network, AvatarRecipe) and self.network.normalisation == "batch" and self.ranks > 1:
            raise ValueError(
                f"network.normalisation 'batch' would be each rank's own, but ranks is {self.ranks}: use 'group'"
            )

    def last_step(self, steps_per_epoch: int) -> int:
        """The step at which a training ends, unless early stopping ends it before."""
        return self.steps or self.epochs * steps_per_epoch

    def require_same_learning(self, other: "TrainingRecipe", *, where: str, section: str = "training") -> None:
        """Raise if a run that is to be resumed was trained by another recipe.

        ``section``: where this one stands in its workflow's, for the message.

        Raises
        ------
        RecipeError
            A field that changes what is learned differs; how often to log or where to run may differ.
        """
        ignored = _HOW_IT_RUNS - (_WHEN_IT_STOPS if self.early_stopping else set())
        changed = [
            f"{section}.{name}: {getattr(other, name)} there, {getattr(self, name)} here"
            for name in type(self).model_fields
            if name not in ignored and _meant(getattr(self, name)) != _meant(getattr(other, name))
        ]
        if changed:
            raise RecipeError(
                f"{where} was trained by another recipe ({'; '.join(changed)}). "
                "Choose another --out, or add --fresh to start over"
            )


def _meant(value: object) -> object:
    """A field's value with what its defaults stand for, so that a default may be spelled out on resume."""
    if isinstance(value, PartsRecipe):
        return value, list(value.joints)  # weights are in their order, which mappings do not compare
    return value.model_copy(update={"warm_up": value.rise}) if isinstance(value, ScheduleRecipe) else value


PATH_KEYS = frozenset({"start_from"})
"""Keys of a training recipe that name files or folders."""

_HOW_IT_RUNS = {
    "ranks", "fewest_ranks", "launcher", "device", "cache", "compile", "budget", "accumulate",
    "log_every", "evaluate_every", "evaluate_triples", "picture_every", "checkpoint_every", "keep_checkpoints",
    "timeout",
}  # fmt: skip
"""Fields that do not change what is learned, so that a run may be resumed with other values of them."""
_WHEN_IT_STOPS = {"evaluate_every", "evaluate_triples"}


class EvaluationRecipe(Frozen):
    """What is measured and drawn."""

    triples: int | None = Field(
        None, ge=1, description="triples of each pose type; default: all that the dataset lists"
    )
    emd_points: int = Field(1024, ge=2, description="vertices in the earth mover's distance (exact assignment)")
    seed: int = Field(0, ge=0, description="seed of the choice of those vertices")
    examples: int = Field(4, ge=1, description="examples of each pose type in the figure and the viewer")
    chunk: int = Field(25, ge=1, description="triples measured by one task")
