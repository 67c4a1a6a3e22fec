"""Weights that the authors released, in their state_dict layout and in ours: DSFFNet's, NPT's and 3D-CoreNet's.

The released modules are convolutions of kernel 1 (weights ``[c, i, 1]``), ours are linear layers (``[c, i]``). Names
correspond part by part, see the two tables. Instance norms have neither weights nor statistics.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor, nn

from datagen.common.errors import CheckpointError
from training.networks.corenet3d import RESIDUAL_BLOCKS, CoreNet3D
from training.networks.dsffnet import DSFFNet
from training.networks.npt import NPT

Network = TypeVar("Network", bound=nn.Module)
Released = str | Path | Mapping[str, Any]
"""A file of ``torch.save``, or what was in it."""

_SHARED = {
    "layers": "", "0": "conv1", "1": "conv2", "2": "conv3",
    "lift": "conv1", "linear1": "conv1", "linear2": "conv2", "linear3": "conv3", "out": "conv4",
}  # fmt: skip
DSFFNET_PARTS = _SHARED | {f"block{i}": f"testres{i}" for i in (1, 2, 3)} | {
    "norm1": "test1", "norm2": "test2",
    "identity_shift": "conv_id1", "identity_scale": "conv_id2", "mixed_shift": "conv_po1", "mixed_scale": "conv_po2",
}  # fmt: skip
NPT_PARTS = _SHARED | {f"block{i}": f"spadain_block{i}" for i in (1, 2, 3)} | {
    "norm1": "spadain1", "norm2": "spadain2", "norm_residual": "spadain_res",
    "scale": "conv_weight", "shift": "conv_bias", "linear_residual": "conv_res",
}  # fmt: skip
"""Parts of our parameter names -> parts of the released ones; parts that are not listed are the same."""

_ENCODER = ("encoder.conv1.weight", "encoder.conv2.weight", "encoder.conv3.weight")
_DECODER = ("decoder.conv1.weight", "decoder.conv2.weight", "decoder.conv3.weight")
_MOST_NAMED = 6


def load_released(files: Sequence[Path], network: Mapping[str, Any]) -> nn.Module:
    """Return the network that a recipe's section names (``name``, of NPT also ``variant``), with released weights.

    Raises
    ------
    CheckpointError
        See `load_released_dsffnet`.
    """
    if network["name"] == "corenet3d":
        return load_released_corenet3d(*files)
    if network["name"] == "npt":
        return load_released_npt(*files, variant=network.get("variant", "maxpool"))
    return load_released_dsffnet(*files)


def load_released_dsffnet(released: Released, **options: Any) -> DSFFNet:
    """Return DSFFNet with released weights (``pt_module.FFAdaINModel``), in evaluation mode.

    Parameters
    ----------
    released
        A file, or its state_dict. Names may begin with ``module.`` (DataParallel); the state_dict may lie under the
        key ``state_dict``. Pickled code is never run.
    **options
        Of `DSFFNet`, for ablations; widths are read from the weights.

    Raises
    ------
    CheckpointError
        Not a checkpoint, or a name is missing, unknown, or of a wrong shape.

    Examples
    --------
    >>> network = load_released_dsffnet("saved_models/model_smpl.pth")        # doctest: +SKIP
    """
    state = read_released(released)
    widths = _widths(state, encoder_widths=_ENCODER, decoder_widths=_DECODER)
    return filled(DSFFNet(**{**widths, **options}), state, DSFFNET_PARTS)


def load_released_npt(released: Released, *, variant: Literal["maxpool", "origin"]) -> NPT:
    """Return NPT with released weights, in evaluation mode.

    Parameters
    ----------
    released
        As for `load_released_dsffnet`.
    variant
        Which script trained it: ``model_maxpool.py`` or ``model.py`` ("origin", as the authors' own
        ``original_169.model``). Both have the same names and shapes, so weights do not tell.

    Raises
    ------
    CheckpointError
        Not a checkpoint, or a name is missing, unknown, or of a wrong shape.
    """
    state = read_released(released)
    return filled(NPT(variant=variant, **_widths(state, encoder_widths=_ENCODER)), state, NPT_PARTS)


def read_released(released: Released) -> dict[str, Tensor]:
    """Return the state_dict of a file or of what was in it, without wrappings.

    Raises
    ------
    CheckpointError
        If it holds no state_dict.
    """
    where = str(released) if isinstance(released, str | Path) else "the given state_dict"
    state = _load(released) if isinstance(released, str | Path) else released
    if isinstance(state, Mapping) and isinstance(state.get("state_dict"), Mapping):
        state = state["state_dict"]
    if not isinstance(state, Mapping) or not state:
        raise CheckpointError(f"{where} holds no weights by name, but {_described(state)}")
    for name, value in state.items():
        if not isinstance(name, str) or not isinstance(value, Tensor) or not value.is_floating_point():
            raise CheckpointError(f"{where} is no state_dict of weights: under {name!r} there is {_described(value)}")
    prefix = "module." if all(name.startswith("module.") for name in state) else ""
    return {name.removeprefix(prefix): value for name, value in state.items()}


def filled(network: Network, state: Mapping[str, Tensor], parts: Mapping[str, str]) -> Network:
    """Return `network` with weights by their released names, every one of them and no other; in evaluation mode.

    Raises
    ------
    CheckpointError
        Naming what is missing, unknown, or of a wrong shape.
    """
    own = network.state_dict()
    names = {name: released_name(name, parts) for name in own}
    _require_fit(state, {names[name]: value for name, value in own.items()}, f"fit {type(network).__name__}")
    network.load_state_dict({name: state[names[name]].reshape(value.shape) for name, value in own.items()})
    return network.eval()


def released_name(name: str, parts: Mapping[str, str]) -> str:
    """Return the released name of one of our parameters.

    >>> released_name("decoder.block2.norm1.mixed_scale.weight", DSFFNET_PARTS)
    'decoder.testres2.test1.conv_po2.weight'
    """
    return ".".join(found for part in name.split(".") if (found := parts.get(part, part)))


def _load(path: str | Path) -> Any:
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise CheckpointError(f"weights {path} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # a file that is no checkpoint can make the reader raise anything
        refused = re.search(r"GLOBAL (\S+)", str(error))
        reason = (
            f"it holds a Python object ({refused[1]}), which is not loaded because that could run code; "
            "save the module's state_dict() instead"
            if refused
            else "it is not a checkpoint of torch.save, or it is damaged"
        )
        raise CheckpointError(f"weights {path} cannot be loaded: {reason}") from error


def _widths(state: Mapping[str, Tensor], **layers: tuple[str, ...]) -> dict[str, Any]:
    """Return constructor arguments from the sizes of layers; a missing one leaves the default, and `filled` tells."""
    return {
        argument: tuple(state[name].shape[0] for name in names)
        for argument, names in layers.items()
        if all(name in state and state[name].ndim and state[name].shape[0] for name in names)
    }


def _released_shape(value: Tensor, name: str = "") -> list[int]:
    """As a convolution over vertices has it: with the width of its kernel, which is 3 where 3D-CoreNet's begins."""
    if name == "fc.weight":
        return [value.shape[0], 3, 3]
    return [*value.shape, 1] if value.ndim == 2 else [*value.shape]


def _require_fit(state: Mapping[str, Tensor], own: Mapping[str, Tensor], what: str) -> None:
    """Raise CheckpointError unless weights have the names, and the shapes, of ``own`` by released names."""
    shapes = {name: _released_shape(value, name) for name, value in own.items()}
    kinds = {
        "missing": [name for name in own if name not in state],
        "unknown": [name for name in state if name not in own],
        "wrong shape": [
            f"{name} {list(state[name].shape)} instead of {shape}"
            for name, shape in shapes.items()
            if name in state and list(state[name].shape) != shape
        ],
    }
    if any(kinds.values()):
        faults = "; ".join(f"{kind}: {_listed(names)}" for kind, names in kinds.items() if names)
        raise CheckpointError(f"these weights do not {what}: {faults}")


def _listed(names: list[str]) -> str:
    more = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def _described(value: Any) -> str:
    return f"a tensor of {value.dtype}" if isinstance(value, Tensor) else f"{type(value).__name__}"


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
    states = {part: read_released(path) for part, path in files.items()}
    network = CoreNet3D(
        feature_widths=_corenet3d_widths(states["correspondence"], "adaptive_feature.layer", correspondence),
        generator_widths=_corenet3d_widths(states["generator"], "conv", generator),
    )
    own = network.state_dict()
    for part, path in files.items():
        names = released_names(part)
        _require_fit(states[part], {name: own[mine] for mine, name in names.items()}, f"fit 3D-CoreNet ({path})")
        # A convolution's weight has one dimension more; the lift's nine inputs lie in the order of the kernel.
        own |= {mine: states[part][name].reshape(own[mine].shape) for mine, name in names.items()}
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


def _corenet3d_widths(tensors: dict[str, Tensor], layers: str, path: Path) -> tuple[int, int, int]:
    names = [f"{layers}{number}.weight" for number in (1, 2, 3)]
    missing = [name for name in names if name not in tensors or tensors[name].ndim == 0]
    if missing:
        hint = "the generator's and the correspondence's file may have been exchanged"
        raise CheckpointError(f"{path} lacks {', '.join(missing)} of the released 3D-CoreNet ({hint})")
    first, second, third = (tensors[name].shape[0] for name in names)
    return first, second, third
