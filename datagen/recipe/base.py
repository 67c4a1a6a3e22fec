"""What every section of a recipe is made of."""

from typing import Any, Self

from pydantic import BaseModel, ConfigDict, model_validator

Range = tuple[float, float]
LARGEST = 2**63 - 1
"""The largest whole number that arrays and stores count with."""


class Frozen(BaseModel):
    """Base of every recipe section: immutable, unknown keys are errors, defaults are validated too."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _truth_is_no_number(cls, values: Any) -> Any:
        for name, field in cls.model_fields.items() if isinstance(values, dict) else ():
            value = values.get(name)
            entries = value if isinstance(value, list | tuple) else [value]
            if field.annotation is not bool and any(isinstance(entry, bool) for entry in entries):
                raise ValueError(f"{name}: true and false are no values of this key")
        return values

    @model_validator(mode="after")
    def _whole_numbers_can_be_counted_with(self) -> Self:
        for name in type(self).model_fields:
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, int) and abs(number) > LARGEST:
                    raise ValueError(f"{name} has {number.bit_length():,} bits, the largest whole number has 63")
        return self


class BodySection(Frozen):
    """Base of the sections of bodies, told apart by ``family``."""

    @property
    def expected_vertices(self) -> float | None:
        """Vertices of a mesh, the mean where its meshes differ; None where they are known once the body is loaded."""
        return None

    @property
    def seconds_a_mesh(self) -> float:
        """Seconds of one core that a mesh takes beside what every mesh does."""
        return 0.0

    @property
    def worker_bytes(self) -> float:
        """Bytes of memory that the body's own files and packages take in each process that poses it, where many."""
        return 0.0
