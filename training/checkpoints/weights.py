"""Weights as files: safetensors that say themselves what they are and whether they are whole; and into a network.

The header of a file of ours holds one JSON object (step, recipe, dataset, and a sha256 over the tensors), so that a
file copied away from its checkpoint can still be used, and a flipped bit in it is still an error. Files of others,
without such a header, load as well; then safetensors' own checks are all there is.
"""

import hashlib
import json
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save, save_file
from torch import Tensor, nn

from datagen.common.errors import CheckpointError, reason_of
from datagen.common.files import fault_in, open_regular, write_atomically

_HEADER, _NAMED_AT_MOST = "dsffnet", 3
_SHORTEST_HEADER = 2  # bytes of an empty JSON object
_LONGEST_HEADER = 16 * 2**20  # bytes; those of our networks have some ten thousand
_MOST_STEPS = 2**53


class About(BaseModel):
    """What a checkpoint's manifest and the header of its weights say, of the types that they say it in."""

    model_config = ConfigDict(strict=True, extra="allow")

    step: Annotated[int, Field(ge=0, lt=_MOST_STEPS)] = 0
    recipe: dict[str, Any] = {}
    dataset: str = ""
    dataset_sha256: str = ""
    versions: dict[str, str] = {}
    best: bool = False
    finished: bool = False
    last_step: Annotated[int, Field(ge=0, lt=_MOST_STEPS)] | None = None


def write_weights(path: Path, weights: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write weights by parameter name, and what they are, into one safetensors file."""
    plain, metadata = _with_header(weights, about)
    path.touch()
    mode = path.stat().st_mode  # as the umask says; safetensors' own files nobody but the owner may read
    save_file(plain, path, metadata=metadata)
    path.chmod(stat.S_IMODE(mode))


def write_weights_atomically(path: Path, weights: Mapping[str, Tensor], about: Mapping[str, Any]) -> None:
    """The same, through memory: the file appears whole or not at all, and its folder with it (else StorageError)."""
    plain, metadata = _with_header(weights, about)
    write_atomically(path, save(plain, metadata=metadata))


def _with_header(weights: Mapping[str, Tensor], about: Mapping[str, Any]) -> tuple[dict[str, Tensor], dict[str, str]]:
    plain = {name: value.detach().cpu().contiguous() for name, value in weights.items()}
    header = json.dumps({**about, "tensors_sha256": _digest(plain)})
    return plain, {_HEADER: header}  # one key: with more their order, and so the bytes, would vary


def read_weights(path: Path) -> dict[str, Tensor]:
    """Weights by parameter name, on the CPU.

    Raises
    ------
    CheckpointError
        The file is missing, cut short, or no safetensors.
    UnsafeFileError
        It is not a regular file.
    """
    try:
        _require_short_header(path)
        return load_file(path)
    except _UNREADABLE as error:
        raise _unreadable(path, reason_of(error)) from error


def read_header(path: Path) -> dict[str, Any]:
    """What a file of weights says about itself; empty for a file that was not written here.

    Raises
    ------
    CheckpointError
        The file is missing or damaged: its tensors are not those that were written.
    UnsafeFileError
        It is not a regular file.
    """
    try:
        _require_short_header(path)
        with safe_open(path, "pt") as file:
            text = (file.metadata() or {}).get(_HEADER, "{}")
        header = about_in(text.encode())
    except ValidationError as error:
        raise _unreadable(path, fault_in(error)) from error
    except _UNREADABLE as error:
        raise _unreadable(path, reason_of(error)) from error
    expected = header.pop("tensors_sha256", None)
    if expected is not None and _digest(read_weights(path)) != expected:
        raise CheckpointError(f"{path} is damaged: its tensors are not those that were written. Copy it again")
    return header


def about_in(content: bytes, kind: type[About] = About) -> dict[str, Any]:
    """Return the JSON object in a manifest or header as it is.

    Raises
    ------
    pydantic.ValidationError
        It is none, is nested too deep, or its values are of other types than those of ``kind``.
    """
    kind.model_validate_json(content)
    return _OBJECT.validate_json(content)


_OBJECT: TypeAdapter[dict[str, Any]] = TypeAdapter(dict[str, Any])
_UNREADABLE = (OSError, SafetensorError, RuntimeError, ValueError, OverflowError)
"""What safetensors and torch make of a file that is missing, cut short or made up."""


def _require_short_header(path: Path) -> None:
    with open_regular(path) as file:
        length = int.from_bytes(file.read(8), "little")
    if not _SHORTEST_HEADER <= length <= _LONGEST_HEADER:
        raise ValueError(f"its header would have {length:,} bytes")


def _unreadable(path: Path, reason: str) -> CheckpointError:
    return CheckpointError(f"{path} cannot be read as weights: {reason}. Name a sound checkpoint")


def cast_weights(weights: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    """Weights with every floating-point tensor in ``dtype``; whole numbers stay as they are.

    Raises
    ------
    CheckpointError
        A finite weight does not fit the range of ``dtype``.
    """
    cast = {name: value.to(dtype) if value.is_floating_point() else value for name, value in weights.items()}
    for name, value in weights.items():
        if bool((cast[name].isinf() & ~value.isinf()).any()):
            largest = float(value.abs().max())
            raise CheckpointError(f"{name} reaches {largest:.3g}, more than {dtype} can hold. Export as bfloat16")
    return cast


def fill_network(network: nn.Module, weights: Mapping[str, Tensor], *, where: str) -> None:
    """Give a network its weights: every name of it, no other, and of its shapes.

    Raises
    ------
    CheckpointError
        Naming what is missing, unexpected or of another shape; the network is as it was.
    """
    own = network.state_dict()
    other = [
        f"{name} {list(weights[name].shape)} (the network's is {list(own[name].shape)})"
        for name in own
        if name in weights and weights[name].shape != own[name].shape
    ]
    faults = [
        *_some("missing", [f"{name} {list(own[name].shape)}" for name in own if name not in weights]),
        *_some("unexpected", [f"{name} {list(weights[name].shape)}" for name in weights if name not in own]),
        *_some("of another shape", other),
    ]
    if faults:
        raise CheckpointError(
            f"{where} holds weights of another network than this {type(network).__name__}: {'; '.join(faults)}. "
            "Name a checkpoint of this network, build the network by the checkpoint's own recipe, or train "
            "weights of an earlier version anew"
        )
    network.load_state_dict(dict(weights))


def _some(what: str, names: list[str]) -> Iterator[str]:
    if names:
        more = f" and {len(names) - _NAMED_AT_MOST} more" if len(names) > _NAMED_AT_MOST else ""
        yield f"{what}: {', '.join(names[:_NAMED_AT_MOST])}{more}"


def _digest(weights: Mapping[str, Tensor]) -> str:
    """Return the sha256 over names, types, shapes and bytes of tensors on the CPU."""
    digest = hashlib.sha256()
    for name in sorted(weights):
        value = weights[name]
        digest.update(f"{name} {value.dtype} {list(value.shape)}\n".encode())
        digest.update(value.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
