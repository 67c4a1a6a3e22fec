"""Random models in SMPL's layout, in the file formats that people hold, and the reference implementation of them."""

import pickle
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import scipy.sparse
import torch
from numpy.typing import NDArray
from smplx.lbs import lbs

from datagen.poses import PARENTS

Arrays = dict[str, NDArray[Any]]


def random_model(parents: tuple[int, ...], *, vertices: int = 150, betas: int = 10, seed: int = 0) -> Arrays:
    """A body of no shape that has everything: shape and pose blend shapes, regressed joints, blended weights.

    Bones are about 0.15 m long and vertices lie within decimetres of the joints that carry them, as in a body.
    """
    random, count = np.random.default_rng(seed), len(parents)
    joints = np.zeros((count, 3))
    for joint, parent in enumerate(parents[1:], start=1):
        joints[joint] = joints[parent] + random.normal(0, 0.08, 3)
    template = joints[random.integers(0, count, vertices)] + random.normal(0, 0.05, (vertices, 3))
    apart = np.linalg.norm(template[:, None] - joints, axis=-1)
    weights = np.exp(-apart / 0.04)
    weights = np.where(weights < 0.2 * weights.max(axis=1, keepdims=True), 0, weights)
    regressor = np.where(apart <= np.sort(apart, axis=0)[9], random.uniform(0.1, 1, apart.shape), 0).T
    return {
        "v_template": template,
        "shapedirs": random.normal(0, 0.01, (vertices, 3, betas)),
        "posedirs": random.normal(0, 0.004, (vertices, 3, 9 * (count - 1))),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, *parents[1:]], range(count)], np.uint32),
        "f": np.stack([np.arange(vertices), np.arange(1, vertices + 1), np.arange(2, vertices + 2)], 1) % vertices,
    }


def tree(model: str) -> tuple[int, ...]:
    """Parents in SMPL's, SMPL-H's and SMPL-X' files."""
    hands = {"smpl": [], "smplh": [(20, 22), (21, 37)], "smplx": [(20, 25), (21, 40)]}[model]
    parents = [*PARENTS[:22], *([15, 15, 15] if model == "smplx" else [])]
    for wrist, first in hands:
        parents += [parent for n in range(first, first + 15, 3) for parent in (wrist, n, n + 1)]
    return tuple(parents) if hands else PARENTS


def arrays_of(model: str) -> Arrays:
    return random_model(tree(model), betas=20 if model == "smplx" else 10)


def reference(arrays: Arrays, betas: NDArray[np.float64], rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vertices [pose, vertex, 3] by smplx's lbs in float64, for axis-angles [pose, joint, 3]."""
    tensors = {key: torch.from_numpy(np.asarray(arrays[key], np.float64)) for key in arrays if key != "note"}
    parents = tensors["kintree_table"][0].long()
    parents[0] = -1
    posed, _ = lbs(
        torch.from_numpy(betas)[None].expand(len(rotations), -1),
        torch.from_numpy(rotations),
        tensors["v_template"],
        tensors["shapedirs"][..., : len(betas)],
        tensors["posedirs"].reshape(-1, tensors["posedirs"].shape[-1]).T,
        tensors["J_regressor"],
        parents,
        tensors["weights"],
    )
    return posed.numpy()


def save_npz(path: Path, arrays: Arrays) -> Path:
    """As plain .npz."""
    np.savez(path, **arrays)
    return path


@contextmanager
def fake_chumpy() -> Iterator[tuple[type, type]]:
    """Modules chumpy.ch and chumpy.reordering with classes Ch and Select that pickle as chumpy's do."""
    names = ("chumpy", "chumpy.ch", "chumpy.reordering")
    classes = []
    for module, name in zip(names[1:], ("Ch", "Select"), strict=True):
        sys.modules[module] = ModuleType(module)
        classes.append(type(name, (), {"__module__": module, "__qualname__": name}))
        setattr(sys.modules[module], name, classes[-1])
    sys.modules["chumpy"] = ModuleType("chumpy")
    try:
        yield classes[0], classes[1]
    finally:
        for name in names:
            del sys.modules[name]


def save_pickle(path: Path, arrays: Arrays, *, protocol: int = 2) -> Path:
    """As the publishers do: shape directions in a chumpy object, a sparse regressor; and keys nobody needs."""
    with fake_chumpy() as (ch, select):
        held = ch.__new__(ch)
        held.__dict__.update(x=arrays["shapedirs"], _dirty_vars={"x"}, _itr=None, _depends_on_deps={})
        chosen = select.__new__(select)
        chosen.__dict__.update(
            a=held,
            idxs=np.arange(arrays["shapedirs"].size),
            preferred_shape=arrays["shapedirs"].shape,
            _dirty_vars={"a", "idxs"},
        )
        content = {
            **{key: np.asfortranarray(array) if key == "weights" else array for key, array in arrays.items()},
            "shapedirs": chosen,
            "J_regressor": scipy.sparse.csc_matrix(arrays["J_regressor"]),
            "bs_style": "lbs",
            "part2num": np.array([{"pelvis": 0}], object),
        }
        path.write_bytes(pickle.dumps(content, protocol))
    return path
