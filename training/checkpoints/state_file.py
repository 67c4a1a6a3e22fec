"""The file of what a training resumes from (state.pt), read without trusting it."""

import os
import zipfile
from io import BufferedReader
from pathlib import Path
from typing import Any

import torch

from datagen.common.errors import CheckpointError, UnsafeFileError
from datagen.common.files import open_regular, resolve_within


def read_state(folder: Path, name: str) -> dict[str, Any]:
    """Return the dictionary of tensors, numbers and texts in a file that ``torch.save`` wrote; no code of it is run.

    Raises
    ------
    CheckpointError
        It is missing, damaged, or holds more than such values.
    UnsafeFileError
        It leads out of the folder, or is not a regular file.
    """
    try:
        with open_regular(resolve_within(folder, name)) as file:
            _require_no_larger(file)
            found = torch.load(file, map_location="cpu", weights_only=True)
    except UnsafeFileError:
        raise
    except Exception as error:  # whatever a pickle raises; torch's own words say how to run its code
        raise unusable_state(folder, f"{name} cannot be read: {type(error).__name__}") from error
    if not isinstance(found, dict):
        raise unusable_state(folder, f"{name} holds a {type(found).__name__}")
    return found


def _require_no_larger(file: BufferedReader) -> None:
    """Refuse an archive whose entries are larger than itself, compressed or overlapping, as torch writes none."""
    size = file.seek(0, os.SEEK_END)
    with zipfile.ZipFile(file) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > size:
            raise ValueError(f"it holds more than its {size:,} bytes")
    file.seek(0)


def unusable_state(folder: Path, reason: str) -> CheckpointError:
    """Return the error of a checkpoint whose state training cannot resume from."""
    return CheckpointError(
        f"{folder} holds no state that training can resume from ({reason}). "
        f"Begin from its weights: --set training.start_from={folder}, in another --out"
    )
