"""The typed recipes of training and evaluation."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from datagen.errors import RecipeError
from datagen.recipe import Frozen

Widths = tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]


class DsffnetRecipe(Frozen):
    """DSFFNet; the defaults are the paper's (9,371,023 parameters)."""

    name: Literal["dsffnet"] = Field("dsffnet", description="network, see training.networks")
    encoder_widths: Widths = Field((64, 128, 1024), description="channels of the pose encoder's layers")
    decoder_widths: Widths = Field((256, 1024, 256), description="channels of the decoder's three blocks")
    feature_fusion: bool = Field(True, description="false: ablation w/o FFAdaIN (paper, Table 3)")
    target_side: bool = Field(True, description="false: ablation w/o the target side's own branch (paper, Table 3)")

    @model_validator(mode="after")
    def _something_modulates(self) -> "DsffnetRecipe":
        if not (self.feature_fusion or self.target_side):
            raise ValueError(
                "feature_fusion and target_side cannot both be false: nothing would be left to modulate by"
            )
        return self


class NptRecipe(Frozen):
    """The baseline NPT; the defaults are its released code's (6,054,941 parameters)."""

    name: Literal["npt"] = Field("npt", description="network, see training.networks")
    variant: Literal["maxpool", "origin"] = Field(
        "maxpool",
        description="maxpool: one pose vector a mesh; origin: one a vertex, source and target paired by index",
    )
    encoder_widths: Widths = Field((64, 128, 1024), description="channels of the pose encoder; the decoder's follow")


def _with_network_name(values: Any) -> Any:
    """Recipes that name no network mean DSFFNet."""
    return {"name": DEFAULT_NETWORK, **values} if isinstance(values, dict) else values


DEFAULT_NETWORK = "dsffnet"


class CoreNet3dRecipe(Frozen):
    """3D-CoreNet; the defaults are the paper's (24,461,447 parameters)."""

    name: Literal["corenet3d"] = "corenet3d"
    feature_widths: Widths = Field((64, 128, 256), description="channels of the vertex features' layers")
    generator_widths: Widths = Field((1024, 512, 256), description="channels of the generator's three blocks")
    centre_features: bool = Field(False, description="centre features over channels before they are compared")


NETWORK_NAMES = ("dsffnet", "npt", "corenet3d")

NetworkRecipe = Annotated[
    Annotated[DsffnetRecipe | NptRecipe | CoreNet3dRecipe, Field(discriminator="name")],
    BeforeValidator(_with_network_name),
]
"""The network of a training: one class a network, told apart by ``name``."""


class ScheduleRecipe(Frozen):
    """Learning rate over the run."""

    name: Literal["step", "one_cycle"] = Field(
        "step", description="step: times ``decay`` every ``decay_epochs``; one_cycle: warm-up, then cosine to zero"
    )
    decay: float = Field(0.8, gt=0, le=1, description="step: factor (paper: 0.8)")
    decay_epochs: int = Field(8, ge=1, description="step: epochs between decays (paper: 8)")
    warm_up: float = Field(0.1, gt=0, lt=1, description="one_cycle: fraction of the steps spent rising")


class TrainingRecipe(Frozen):
    """How a network is trained; the defaults are the DSFFNet paper's (section 4.2)."""

    network: NetworkRecipe = Field(default_factory=DsffnetRecipe)
    edge_weight: float = Field(0.0005, ge=0, description="lambda of the edge-length loss (0: ablation w/o L_edge)")
    batch: int = Field(8, ge=1, description="triples in a step, over all ranks together")
    epochs: int = Field(200, ge=1, description="epochs; one epoch is identities x poses triples")
    steps: int | None = Field(None, ge=1, description="stop after this many steps instead; the schedule spans them")
    learning_rate: float = Field(1e-3, gt=0, description="highest learning rate of AdamW")
    weight_decay: float = Field(0.01, ge=0, description="weight decay of AdamW")
    gradient_clip: float | None = Field(None, gt=0, description="largest gradient norm")
    schedule: ScheduleRecipe = Field(default_factory=ScheduleRecipe)
    seed: int = Field(0, ge=0, description="seed of the weights and of the order of triples")
    ranks: int = Field(1, ge=1, description="processes that train together (DDP)")
    launcher: Literal["ray", "inline"] = Field("ray", description="ray: Ray Train; inline: this process, one rank")
    precision: Literal["float32", "tf32", "bfloat16"] = Field(
        "float32", description="of the wide matrix products; norms, losses and weights stay float32"
    )
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="auto: CUDA where there is one")
    log_every: int = Field(20, ge=1, description="steps between lines of metrics.jsonl")
    evaluate_every: int = Field(500, ge=1, description="steps between PMD measurements on a fixed evaluation subset")
    evaluate_triples: int = Field(32, ge=1, description="triples of each pose type in that subset")
    checkpoint_every: int = Field(500, ge=1, description="steps between checkpoints")
    keep_checkpoints: int = Field(2, ge=1, description="newest checkpoints that are kept")
    timeout: int = Field(300, ge=10, description="seconds after which a rank gives up waiting for the others")

    @model_validator(mode="after")
    def _consistent(self) -> "TrainingRecipe":
        if self.batch % self.ranks:
            raise ValueError(f"batch {self.batch} cannot be shared equally by {self.ranks} ranks")
        if self.launcher == "inline" and self.ranks > 1:
            raise ValueError(f"launcher 'inline' is one process, but ranks is {self.ranks}; use launcher 'ray'")
        return self

    def require_same_learning(self, other: "TrainingRecipe", *, where: str) -> None:
        """Refuse to go on from a run that learned by another recipe.

        Raises
        ------
        RecipeError
            A field that changes what is learned differs; how often to log or where to run may differ.
        """
        changed = [
            f"training.{name}: {getattr(other, name)} there, {getattr(self, name)} here"
            for name in type(self).model_fields
            if name not in _HOW_IT_RUNS and getattr(self, name) != getattr(other, name)
        ]
        if changed:
            raise RecipeError(
                f"{where} was trained by another recipe ({'; '.join(changed)}). "
                "Choose another --out, or add --fresh to start over"
            )


_HOW_IT_RUNS = {
    "ranks", "launcher", "device", "log_every", "evaluate_every", "evaluate_triples", "checkpoint_every",
    "keep_checkpoints", "timeout",
}  # fmt: skip
"""Fields that do not change what is learned, so that a run may go on with other values of them."""


class EvaluationRecipe(Frozen):
    """What is measured and drawn."""

    triples: int | None = Field(
        None, ge=1, description="triples of each pose type; default: all that the dataset lists"
    )
    emd_points: int = Field(1024, ge=2, description="vertices in the earth mover's distance (exact assignment)")
    seed: int = Field(0, ge=0, description="seed of the choice of those vertices")
    examples: int = Field(4, ge=1, description="examples of each pose type in the figure and the viewer")
    chunk: int = Field(25, ge=1, description="triples measured by one task")
