"""Mesh files in the layouts that importers read, small, and each unlike the others."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.mesh.files import save_mesh
from datagen.mesh.geometry import Mesh

FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def tetrahedron(identity: int, pose: int) -> NDArray[np.float32]:
    """Vertices [4, 3] that tell identity and pose: the corner at 1 + identity along x and 1 + pose along y."""
    return np.array([[0, 0, 0], [1 + identity, 0, 0.1], [0, 1 + pose, 0.2], [0.3, 0, 1 / 3]], np.float32)


def save(path: Path, identity: int, pose: int) -> None:
    """Write that tetrahedron."""
    save_mesh(Mesh(tetrahedron(identity, pose), FACES), path)


def npt_folder(folder: Path, *, identities: range, poses: range, name: str = "{}_{}.ply") -> Path:
    """A grid in NPT's layout."""
    for identity in identities:
        for pose in poses:
            save(folder / name.format(identity, pose), identity, pose)
    return folder


def faust_folder(folder: Path, *, subjects: range = range(10)) -> Path:
    """FAUST's registrations of some subjects."""
    for subject in subjects:
        for pose in range(10):
            save(folder / f"tr_reg_{10 * subject + pose:03d}.ply", subject, pose)
    return folder


def garment_folder(folder: Path, names: tuple[str, ...]) -> Path:
    """MultiGarment's folders; garment n has 3 + n vertices."""
    for number, name in enumerate(names):
        angle = np.linspace(0, 5, 3 + number)
        fan = np.stack([np.zeros(1 + number), np.arange(1, 2 + number), np.arange(2, 3 + number)], axis=1)
        vertices = np.stack([np.cos(angle), np.sin(angle), angle], axis=1)
        save_mesh(Mesh(vertices, fan.astype(int)), folder / name / "smpl_registered.obj")
    return folder
