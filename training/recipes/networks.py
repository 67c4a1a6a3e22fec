"""The networks of a training recipe: one class a network, told apart by ``name``."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from datagen.recipe import Frozen

Widths = tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]


class DsffnetRecipe(Frozen):
    """DSFFNet; the defaults are the paper's (9,371,023 parameters)."""

    name: Literal["dsffnet"] = Field("dsffnet", description="network, see training.networks")
    encoder_widths: Widths = Field((64, 128, 1024), description="channels of the pose encoder's layers")
    decoder_widths: Widths = Field((256, 1024, 256), description="channels of the decoder's three blocks")
    feature_fusion: bool = Field(True, description="false: ablation w/o FFAdaIN (paper, Table 3)")
    target_side: bool = Field(True, description="false: ablation w/o the target side's own branch (paper, Table 3)")
    initial_mixing: float = Field(
        0.0, ge=-1, le=2, description="alpha and beta of every FFAdaIN at first: 0 all target side (paper), 1 all mixed"
    )

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
