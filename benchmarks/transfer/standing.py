"""By how many degrees weights err that find how a mesh stands: ``python -m benchmarks.transfer.standing human``.

Anny bodies that the weights have not seen, of several vertex layouts, turned in several ways. Set OMP_NUM_THREADS=1 on
a busy machine.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.bodies import load_body
from datagen.poses import draw_poses
from datagen.recipe import AnnyBody, AnnyTopology, PhenotypeRanges, PoseRecipe
from training.inference.transfer import PoseTransfer
from workflows.pretrained import weights_named

BODIES: tuple[tuple[AnnyTopology, int, int], ...] = (
    ("notoes_collapse5pc", 20, 3), ("notoes_collapse3pc", 10, 2), ("notoes_collapse10pc", 10, 2), ("anny", 10, 2),
)  # fmt: skip
"""Topology, identities, poses of each."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="a run, or weights that come along, of a network that finds how meshes stand")
    transfer = PoseTransfer.from_run(weights_named(parser.parse_args().weights))
    for topology, identities, poses in BODIES:
        report_found(transfer, list(anny(topology, identities, poses)))


def anny(topology: AnnyTopology, identities: int, poses: int) -> Iterator[NDArray[np.float64]]:
    """Vertices [n, 3] of bodies from babies to old people in poses as the recipes draw them."""
    body = load_body(AnnyBody(topology=topology, phenotypes=PhenotypeRanges(age=(0.0, 1.0))))
    recipe = PoseRecipe(seen=identities * poses, unseen=0, seed=11)
    for identity in range(identities):
        parameters = body.draw_identity(np.random.default_rng(1000 + identity), identity)
        drawn = draw_poses(recipe, np.arange(identity * poses, (identity + 1) * poses))
        yield from body.vertices(parameters, drawn).astype(np.float64)


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


if __name__ == "__main__":
    main()
