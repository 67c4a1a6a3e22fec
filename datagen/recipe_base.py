"""What every section of a recipe is made of."""

from pydantic import BaseModel, ConfigDict

Range = tuple[float, float]


class Frozen(BaseModel):
    """Base of every recipe section: immutable, unknown keys are errors, defaults are validated too."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)
