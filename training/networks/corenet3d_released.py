"""Weights of the released 3D-CoreNet: two files of a ``state_dict`` each, ``*_net_Corr.pth`` and ``*_net_G.pth``."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from torch import Tensor

from training.checkpoint import CheckpointError
from training.networks.corenet3d import RESIDUAL_BLOCKS, CoreNet3D

_ELAIN_NAMES = {"side": "same", "scale": "gamma", "shift": "beta", "blend": "weight"}
_SPECTRAL_NAMES = {"original": "weight_orig", "0._u": "weight_u", "0._v": "weight_v"}


def load_released_corenet3d(generator: Path, correspondence: Path) -> CoreNet3D:
    """Return the network of the released files, in evaluation mode, on the CPU.

    The widths are those of the files. Names may begin with ``module.``, as a network under data parallel saves them.

    Parameters
    ----------
    generator
        ``*_net_G.pth``.
    correspondence
        ``*_net_Corr.pth``.

    Raises
    ------
    CheckpointError
        A file cannot be read as tensors by name, or a tensor is missing, left over or of another shape.
    """
    files = {"generator": generator, "correspondence": correspondence}
    found = {part: _tensors(path) for part, path in files.items()}
    network = CoreNet3D(
        feature_widths=_widths(found["correspondence"], "adaptive_feature.layer", correspondence),
        generator_widths=_widths(found["generator"], "conv", generator),
    )
    own = network.state_dict()
    for part, path in files.items():
        _require_same(found[part], {name: own[mine] for mine, name in released_names(part).items()}, path)
    for part in files:
        for mine, name in released_names(part).items():
            # A convolution's weight has one dimension more; the lift's nine inputs lie in the order of the kernel.
            own[mine] = found[part][name].reshape(own[mine].shape)
    network.load_state_dict(own)
    return network.eval()


def released_names(part: str) -> dict[str, str]:
    """Return the released name of every parameter and buffer of ``"generator"`` or ``"correspondence"``, by ours."""
    return dict(_generator_names() if part == "generator" else _correspondence_names())


def _correspondence_names() -> Iterator[tuple[str, str]]:
    for index in range(3):
        yield from _layer(f"features.layers.{index}", f"adaptive_feature.layer{index + 1}")
    for index in range(RESIDUAL_BLOCKS):
        yield from _layer(f"features.blocks.{index}.linear1", f"layer.{index}.conv1")
        yield from _layer(f"features.blocks.{index}.linear2", f"layer.{index}.conv2")
        yield f"features.blocks.{index}.activation.weight", f"layer.{index}.prelu.weight"
    yield from _layer("theta", "theta")
    yield from _layer("phi", "phi")


def _generator_names() -> Iterator[tuple[str, str]]:
    for mine, name in {
        "lift": "fc",
        "linear1": "conv1",
        "linear2": "conv2",
        "linear3": "conv3",
        "out": "conv4",
    }.items():
        yield from _layer(f"generator.{mine}", name)
    for number in (1, 2, 3):
        block, name = f"generator.block{number}", f"elain_block{number}"
        for norm, suffix in {"norm0": "0", "norm1": "1", "norm_shortcut": "s"}.items():
            for layer, released in _ELAIN_NAMES.items():
                yield from _layer(f"{block}.{norm}.{layer}", f"{name}.norm_{suffix}.mlp_{released}")
        for linear, suffix in {"linear0": "0", "linear1": "1", "shortcut": "s"}.items():
            for tensor, released in _SPECTRAL_NAMES.items():
                yield f"{block}.{linear}.parametrizations.weight.{tensor}", f"{name}.conv_{suffix}.{released}"
        yield f"{block}.linear0.bias", f"{name}.conv_0.bias"
        yield f"{block}.linear1.bias", f"{name}.conv_1.bias"


def _layer(mine: str, name: str) -> Iterator[tuple[str, str]]:
    yield f"{mine}.weight", f"{name}.weight"
    yield f"{mine}.bias", f"{name}.bias"


def _tensors(path: Path) -> dict[str, Tensor]:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, KeyError, pickle.UnpicklingError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise CheckpointError(f"{path} cannot be read as released weights: {reason}") from error
    if not isinstance(content, Mapping) or not all(isinstance(value, Tensor) for value in content.values()):
        raise CheckpointError(f"{path} must hold tensors by name (a state_dict), it holds {type(content).__name__}")
    return {str(name).removeprefix("module."): value for name, value in content.items()}


def _widths(tensors: dict[str, Tensor], layers: str, path: Path) -> tuple[int, int, int]:
    names = [f"{layers}{number}.weight" for number in (1, 2, 3)]
    missing = [name for name in names if name not in tensors or tensors[name].ndim == 0]
    if missing:
        hint = "the generator's and the correspondence's file may have been exchanged"
        raise CheckpointError(f"{path} lacks {', '.join(missing)} of the released 3D-CoreNet ({hint})")
    first, second, third = (tensors[name].shape[0] for name in names)
    return first, second, third


def _require_same(found: dict[str, Tensor], expected: dict[str, Tensor], path: Path) -> None:
    faults = [f"missing: {name}" for name in expected if name not in found]
    faults += [f"unknown: {name}" for name in found if name not in expected]
    faults += [
        f"{name}: shape {list(found[name].shape)}, expected {_released_shape(name, value)}"
        for name, value in expected.items()
        if name in found and list(found[name].shape) != _released_shape(name, value)
    ]
    if faults:
        shown = "; ".join(faults[:5]) + (f"; and {len(faults) - 5} more" if len(faults) > 5 else "")
        raise CheckpointError(f"{path} does not hold the released 3D-CoreNet: {shown}")


def _released_shape(name: str, own: Tensor) -> list[int]:
    """Return the shape as a convolution over vertices has it: with the width of its kernel."""
    if name == "fc.weight":
        return [own.shape[0], 3, 3]
    return [*own.shape, 1] if own.ndim == 2 else list(own.shape)
