"""Records of tensors as files: one safetensors file each, whose header says what they are."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar, Self

from datagen.common.errors import CheckpointError
from training.checkpoints.weights import read_weights, write_weights_atomically


@dataclass(frozen=True, eq=False)
class TensorRecord:
    """Base of dataclasses whose fields are tensors; ``kind`` says in words what they are together."""

    kind: ClassVar[str]

    def save(self, path: Path) -> None:
        """Write the fields as safetensors."""
        write_weights_atomically(path, {its.name: getattr(self, its.name) for its in fields(self)}, {"kind": self.kind})

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what :meth:`save` wrote.

        Raises
        ------
        CheckpointError
            The file is missing, damaged, or holds something else.
        """
        read, names = read_weights(path), [its.name for its in fields(cls)]
        if read.keys() != set(names):
            found = ", ".join(sorted(read)[:5]) or "nothing"
            raise CheckpointError(f"{path} holds no {cls.kind}, but {found}: not {', '.join(names)}")
        return cls(**read)
