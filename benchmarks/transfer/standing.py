"""What is said of how a mesh stands: ``python -m benchmarks.transfer.standing workflows/pretrained/anny-quickstart``.

Anny bodies that the weights have not seen, of the vertex layout that they were trained on and of others, and the twelve
CC0 animals, each turned about the vertical by 0 to 80 degrees; 90 degrees only permute the 24 ways, as does every other
way of laying a mesh along the axes, so those are counted from the same errors. Of weights that find by themselves how
meshes stand (workflows/pretrained/human): by how many degrees they err. Set OMP_NUM_THREADS=1 on a busy machine.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.bodies import load_body
from datagen.characters.cc0_animals import animal_files
from datagen.mesh.files import read_mesh_file
from datagen.poses import draw_poses
from datagen.recipe import AnnyBody, AnnyTopology, PhenotypeRanges, PoseRecipe
from training.inference.orientation import EVERY_AXES, UPRIGHT, Axes, Orientation, orientation
from training.inference.transfer import PoseTransfer

ANGLES = range(0, 90, 10)
BODIES: tuple[tuple[AnnyTopology, int, int], ...] = (
    ("notoes_collapse5pc", 20, 3), ("notoes_collapse3pc", 10, 2), ("notoes_collapse10pc", 10, 2), ("anny", 10, 2),
)  # fmt: skip
"""Topology, identities, poses of each; the quickstart trains on the first."""


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    transfer = PoseTransfer.from_run(parser.parse_args().run)
    if transfer.finds_standing:
        for topology, identities, poses in BODIES:
            report_found(transfer, list(anny(topology, identities, poses)))
        misfits = sorted(transfer.misfit(read_animal(path)) for path in animal_files())
        print(f"animals as they stand: misfit {misfits[0]:.4f} to {misfits[-1]:.4f}")
        return
    print("| meshes | turned by, degrees | nothing | may be ..., the result may be poor | right axes | wrong axes |")
    print("|---|---:|---:|---:|---:|---:|")
    for topology, identities, poses in BODIES:
        bodies = list(anny(topology, identities, poses))
        report(transfer, f"Anny, {len(bodies[0]):,} vertices", bodies)
    report(transfer, "animals", [read_animal(path) for path in animal_files()])


def anny(topology: AnnyTopology, identities: int, poses: int) -> Iterator[NDArray[np.float64]]:
    """Vertices [n, 3] of bodies from babies to old people in poses as the recipes draw them."""
    body = load_body(AnnyBody(topology=topology, phenotypes=PhenotypeRanges(age=(0.0, 1.0))))
    recipe = PoseRecipe(seen=identities * poses, unseen=0, seed=11)
    for identity in range(identities):
        parameters = body.draw_identity(np.random.default_rng(1000 + identity), identity)
        drawn = draw_poses(recipe, np.arange(identity * poses, (identity + 1) * poses))
        yield from body.vertices(parameters, drawn).astype(np.float64)


def read_animal(path: Path) -> NDArray[np.floating]:
    """Vertices of an animal at rest; the stag's without its horns, which are a mesh of their own."""
    return read_mesh_file(path, geometries=["Stag"] if path.stem == "stag" else []).mesh.vertices


def report(transfer: PoseTransfer, name: str, meshes: list[NDArray[np.floating]]) -> None:
    """A row for every angle, and one for the 23 other ways along the axes."""
    for degrees in ANGLES:
        ways = [orientation(transfer.self_errors, [about_the_vertical(mesh, degrees)]) for mesh in meshes]
        truth = Axes("Y", "X") if degrees > 45 else UPRIGHT
        print_row(name, str(degrees), Counter(said(way, truth) for way in ways))
        if not degrees:
            found = Counter(laid(way, axes) for way in ways for axes in EVERY_AXES if axes != UPRIGHT)
            print_row(name, "the 23 other ways along the axes", found)


def report_found(transfer: PoseTransfer, meshes: list[NDArray[np.floating]]) -> None:
    """Degrees by which bodies are from upright after they were turned as a network of its own finds."""
    random = np.random.default_rng(0)
    kinds: dict[str, Callable[[], Rotation]] = {
        "upright": Rotation.identity,
        "about the vertical by any angle": lambda: Rotation.from_euler("y", random.uniform(0, 2 * np.pi)),
        "lying, by any angle": lambda: Rotation.from_euler("yx", [random.uniform(0, 2 * np.pi), np.pi / 2]),
        "any rotation": lambda: Rotation.random(random_state=int(random.integers(2**31))),
    }
    for kind, draw in kinds.items():
        left = []
        for mesh in meshes:
            turn = draw()
            left.append(
                np.degrees((Rotation.from_matrix(transfer.standing(turn.apply(mesh)).matrix) * turn).magnitude())
            )
        middle, most, far = np.median(left), np.max(left), int(np.sum(np.array(left) > 15))
        print(
            f"{len(meshes[0]):,} vertices, {kind}: {middle:.1f} degrees left (median), {most:.1f} at most, "
            f"{far} of {len(left)} beyond 15",
            flush=True,
        )


def print_row(name: str, turned: str, found: Counter[str]) -> None:
    """Shares of what was said."""
    shares = (found[what] / found.total() for what in ("nothing", "careful", "right", "wrong"))
    print(f"| {name} | {turned} | {' | '.join(f'{share:.0%}' for share in shares)} |", flush=True)


def said(way: Orientation, truth: Axes) -> str:
    """What :func:`training.inference.domain_check.remarks` says of a mesh that is taken to stand as the training
    data."""
    if way.fits(UPRIGHT):
        return "nothing"
    return "careful" if not way.is_certain else "right" if way.best == truth else "wrong"


def laid(upright: Orientation, axes: Axes) -> str:
    """What is said of a mesh laid by ``axes``, from the errors of how it stands upright."""
    matrices = [each.matrix @ axes.matrix.T for each in EVERY_AXES]
    order = [next(n for n, each in enumerate(EVERY_AXES) if np.allclose(each.matrix, m)) for m in matrices]
    way = Orientation(upright.errors[order], upright.turned)
    return said(way, axes)


def about_the_vertical(mesh: NDArray[np.floating], degrees: float) -> NDArray[np.floating]:
    """The mesh turned."""
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    return mesh @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])


if __name__ == "__main__":
    main()
