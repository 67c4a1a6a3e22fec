"""Files of body models in SMPL's layout: reading, checking, converting
(:mod:`datagen.bodies.smpl_family.model_search` finds them).

The layout is seven arrays (Loper et al. 2015 and the files of SMPL, SMPL-H, SMPL-X and SMAL): ``v_template`` [V, 3],
``shapedirs`` [V, 3, betas], ``posedirs`` [V, 3, 9 (J - 1)], ``J_regressor`` [J, V], ``weights`` [V, J],
``kintree_table`` [2, J] and ``f`` [F, 3], in an .npz or in the original pickle. Pickles are read without running
anything in them (:mod:`datagen.bodies.smpl_family.safe_pickle`).
"""

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from datagen.bodies.smpl_family.safe_pickle import unpickle
from datagen.bodies.smpl_family.safe_pickle_arrays import array_of
from datagen.common import npz
from datagen.common.errors import BodyError, reason_of
from datagen.common.files import write_atomically

KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
NOTE = "note"  # what a licence-free stand-in says of itself


@dataclass(frozen=True)
class ModelFile:
    """A checked model in SMPL's layout: float64 arrays as the module describes, and the tree of its joints.

    ``note`` is what a licence-free stand-in says of itself, empty for a model of its publishers.
    """

    path: Path
    template: NDArray[np.float64]
    shapedirs: NDArray[np.float64]
    posedirs: NDArray[np.float64]
    regressor: NDArray[np.float64]
    weights: NDArray[np.float64]
    parents: tuple[int, ...]
    faces: NDArray[np.int32]
    note: str


def read_arrays(
    path: Path, keys: tuple[str, ...], *, optional: tuple[str, ...] = (), what: str = "a body model in SMPL's layout"
) -> dict[str, NDArray[Any]]:
    """The named arrays of an .npz or a pickle of a dictionary, whatever the file is called; others are not looked at.

    Raises
    ------
    BodyError
        The file is missing or damaged, a key is lacking, or a pickle names what no model file needs.
    """
    if not path.is_file():
        raise BodyError(f"no model file at {path}")
    read = _read_npz if zipfile.is_zipfile(path) else _read_pickle
    arrays = read(path, (*keys, *optional))
    lacking = [key for key in keys if key not in arrays]
    if lacking:
        raise BodyError(f"{path} has no {lacking[0]!r}, so it is not {what}, which has {', '.join(keys)}")
    return arrays


def _read_pickle(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    if path.stat().st_size > 2 * npz.LARGEST:
        raise BodyError(f"{path} has more bytes than any body model; download it again")
    with open(path, "rb") as file:
        content = unpickle(file, name=str(path))
    if not isinstance(content, dict):
        raise BodyError(f"{path} holds {type(content).__name__}, not the dictionary of arrays that a model file is")
    return {key: array_of(content[key], name=f"{key!r} in {path}") for key in keys if key in content}


def _read_npz(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Those of Python objects, as np.savez makes of a sparse matrix, go through our own unpickling."""

    def recorded(key: str, content: BinaryIO) -> NDArray[Any]:
        return array_of(unpickle(content, name=f"{key!r} in {path}"), name=f"{key!r} in {path}")

    try:
        return npz.read_arrays(path, keys, pickled=recorded)
    except npz.FAULTS as error:
        raise BodyError(f"{path} is damaged ({reason_of(error)}); copy or download it again") from error


def read_model(path: Path) -> ModelFile:
    """Read and check a model file.

    Raises
    ------
    BodyError
        It is missing, damaged, refused (see :func:`datagen.bodies.smpl_family.safe_pickle.unpickle`), or not a model
        in SMPL's layout.
    """
    arrays = read_arrays(path, KEYS, optional=(NOTE,))
    try:
        numbers = {key: np.asarray(arrays[key], np.float64) for key in KEYS[:5]}
        table, faces = (np.asarray(arrays[key]).astype(np.int64) for key in KEYS[5:])
        note = str(arrays.get(NOTE, ""))
    except (ValueError, TypeError) as error:
        raise BodyError(f"{path} is no body model: its arrays are not numbers ({error})") from error
    _check(path, numbers, table, faces)
    return ModelFile(
        path=path,
        template=numbers["v_template"],
        shapedirs=numbers["shapedirs"],
        posedirs=numbers["posedirs"],
        regressor=numbers["J_regressor"],
        weights=numbers["weights"],
        parents=_tree(path, table),
        faces=faces.astype(np.int32),
        note=note,
    )


def _check(
    path: Path, arrays: dict[str, NDArray[np.float64]], table: NDArray[np.int64], faces: NDArray[np.int64]
) -> None:
    vertices, joints = len(np.atleast_1d(arrays["v_template"])), np.atleast_1d(table).shape[-1]
    expected: dict[str, tuple[int | str, ...]] = {
        "v_template": (vertices, 3),
        "shapedirs": (vertices, 3, "betas"),
        "posedirs": (vertices, 3, 9 * (joints - 1)),
        "J_regressor": (joints, vertices),
        "weights": (vertices, joints),
        "kintree_table": (2, joints),
        "f": ("faces", 3),
    }
    for key, array in {**arrays, "kintree_table": table, "f": faces}.items():
        if not _fits(array.shape, expected[key]):
            wanted = ", ".join(map(str, expected[key]))
            raise BodyError(f"{path}: {key!r} has the shape {list(array.shape)}, but [{wanted}] is needed")
        if not np.isfinite(array).all():
            raise BodyError(f"{path}: {key!r} holds numbers that are not finite; copy or download the file again")
    if faces.min() < 0 or faces.max() >= vertices:
        raise BodyError(f"{path}: 'f' names vertex {faces.max()}, but the model has {vertices}")
    sums = arrays["weights"].sum(axis=1)
    worst = int(np.abs(sums - 1).argmax())
    if abs(sums[worst] - 1) > 1e-3:
        raise BodyError(f"{path}: the 'weights' of vertex {worst} sum to {sums[worst]:.4g} instead of 1")


def _fits(shape: tuple[int, ...], expected: tuple[int | str, ...]) -> bool:
    pairs = zip(shape, expected, strict=False)
    return len(shape) == len(expected) and all(a > 0 and (b == a or isinstance(b, str)) for a, b in pairs)


def _tree(path: Path, table: NDArray[np.int64]) -> tuple[int, ...]:
    """Parents of the joints: -1 for the root (files say -1 or 2^32 - 1), others before their children."""
    parents = [-1, *table[0, 1:].tolist()]
    wrong = [joint for joint, parent in enumerate(parents[1:], start=1) if not 0 <= parent < joint]
    root = int(table[0, 0])
    if wrong or (0 < root < 2**31):
        joint = wrong[0] if wrong else 0
        raise BodyError(
            f"{path}: 'kintree_table' is no tree, as joint {joint} has the parent {int(table[0, joint])}, "
            "which does not come before it"
        )
    return tuple(parents)


def convert_model(source: Path, out: Path) -> Path:
    """Write a model file as a plain .npz of dense arrays that loads without pickles; returns ``out``.

    The arrays keep their types and values, so that a body loaded from either file has the same vertices.

    Raises
    ------
    BodyError
        ``source`` is no usable model file, or ``out`` is not called .npz or another file that is there.
    StorageError
        ``out`` could not be written.
    """
    if out.suffix.lower() != ".npz":
        raise BodyError(f"a converted model is an .npz, so {out} cannot be its name; try {out.with_suffix('.npz')}")
    read_model(source)
    write_model(out, read_arrays(source, KEYS, optional=(NOTE,)))
    return out


def write_model(out: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays as an .npz, whole or not at all; the same arrays give the same bytes.

    Raises
    ------
    BodyError
        Another file is there.
    StorageError
        It could not be written.
    """
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **{key: np.asarray(array, order="C") for key, array in arrays.items()})
    if out.is_file() and out.read_bytes() != content.getvalue():
        raise BodyError(f"{out} is there, and another file than would be written. Choose another --out, or remove it")
    write_atomically(out, content.getvalue())
