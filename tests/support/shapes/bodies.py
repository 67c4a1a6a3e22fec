"""A small recipe of every body family, with poses that it understands; files are made where they are needed."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from datagen.bodies.standins.smpl_format import write_standin
from datagen.common.seeding import Stream, generator
from tests.support.shapes.meshes import npt_folder
from tests.support.shapes.rigged_files import BOXES, JOINTS, Rig, about

COARSE = "notoes_collapse3pc"
FAMILIES = ("anny", "smpl", "smplh", "smplx", "smal", "rigged", "imported", "mixed", "clothed", "leg")
PEOPLE = ("anny", "smpl", "smplh", "smplx", "mixed", "clothed")
NPT = {"name": "npt"}
OLD_CPU = {
    "OPENBLAS_CORETYPE": "Nehalem",
    "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3 AVX512F AVX512CD AVX512_SKX",
    "ATEN_CPU_CAPABILITY": "default",
    "MKL_CBWR": "COMPATIBLE",
}
"""Variables that restrict OpenBLAS, NumPy and PyTorch to what a CPU of 2008 can do."""


def identity(body: Any, number: int = 0, *, seed: int = 0) -> np.ndarray:
    """Parameters of a body's identity, as a recipe with that seed draws them."""
    return np.asarray(body.draw_identity(generator(seed, Stream.IDENTITY, number), number))


def recipe_parts(family: str, folder: Path) -> dict[str, Any]:
    """``body`` and pose ``distribution`` of a family, as a recipe has them; its files go into ``folder``."""
    return _MAKERS[family](folder)


def _anny(folder: Path) -> dict[str, Any]:
    return {"body": {"family": "anny", "topology": COARSE}, "distribution": NPT}


@cache
def _standin(kind: str) -> bytes:
    with TemporaryDirectory() as folder, threadpool_limits(1):
        return write_standin(kind, Path(folder) / "x.npz", topology=COARSE).read_bytes()  # type: ignore[arg-type]


def standin_file(kind: str, path: Path) -> Path:
    """The stand-in of a model at ``path``; making one takes seconds, so that each is made once a process."""
    path.write_bytes(_standin(kind))
    return path


def _smpl(folder: Path, model: str = "smpl") -> dict[str, Any]:
    path = standin_file(model, folder / f"{model}.npz")
    return {"body": {"family": "smpl", "model": model, "path": str(path)}, "distribution": NPT}


def _smal(folder: Path) -> dict[str, Any]:
    path = standin_file("smal", folder / "smal.npz")
    ranges = {"name": "ranges", "skeleton": "smal", "uniform": 15}
    return {"body": {"family": "smal", "path": str(path)}, "distribution": ranges}


def _rigged(folder: Path) -> dict[str, Any]:
    """A person whose clip waves a leg, and one with a tail and no clip."""
    rigs = folder / "rigs"
    rigs.mkdir(exist_ok=True)
    person = Rig()
    person.clips = {"Wave": {"Leg.L": person.keys("Leg.L", [np.eye(3), about("z", 60)], [0.0, 2.0])}}
    person.save(rigs / "person.glb")
    tail = ((-0.02, 0.98, -0.6), (0.02, 1.02, -0.1), "Tail1", "Tail1")
    Rig(joints=JOINTS | {"Tail1": ("Hips", (0.0, 1.0, -0.1))}, boxes=[*BOXES, tail]).save(rigs / "tailed.glb")
    clips = {"name": "clips", "path": str(rigs), "jitter": 20}
    return {"body": {"family": "rigged", "path": str(rigs)}, "distribution": clips}


def _imported(folder: Path) -> dict[str, Any]:
    meshes = npt_folder(folder / "meshes", identities=range(6), poses=range(8))
    return {"body": {"family": "imported", "layout": "npt", "path": str(meshes)}, "distribution": {"name": "found"}}


def _mixed(folder: Path) -> dict[str, Any]:
    return {"body": {"family": "mixed", "bodies": [_anny(folder)["body"], _smpl(folder)["body"]]}, "distribution": NPT}


def _clothed(folder: Path) -> dict[str, Any]:
    solver = {"frames": 2, "substeps": 1, "settle": 21, "subdivide": 0}
    body = {"family": "clothed", "body": _anny(folder)["body"], "outfits": ["skirt", "loose"], "solver": solver}
    return {"body": body, "distribution": NPT}


def _leg(folder: Path) -> dict[str, Any]:
    return {"body": {"family": "leg"}, "distribution": NPT}


_MAKERS = {
    "anny": _anny,
    "smpl": _smpl,
    "smplh": lambda folder: _smpl(folder, "smplh"),
    "smplx": lambda folder: _smpl(folder, "smplx"),
    "smal": _smal,
    "rigged": _rigged,
    "imported": _imported,
    "mixed": _mixed,
    "clothed": _clothed,
    "leg": _leg,
}
