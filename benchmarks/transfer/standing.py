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
from training.inference.predict import load_trained
from training.inference.standing import Understanding, facing, standing, understanding_of
from training.networks.parts import Parts
from workflows.pretrained import weights_named

BODIES: tuple[tuple[AnnyTopology, int, int], ...] = (
    ("notoes_collapse5pc", 20, 3), ("notoes_collapse3pc", 10, 2), ("notoes_collapse10pc", 10, 2), ("anny", 10, 2),
)  # fmt: skip
"""Topology, identities, poses of each."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="a run, or weights that come along, of a network that finds how meshes stand")
    network = load_trained(weights_named(parser.parse_args().weights))[0]
    if not isinstance(network, Parts):
        parser.error("these weights are of a network that does not find how meshes stand")
    for topology, identities, poses in BODIES:
        report_found(understanding_of(network), list(anny(topology, identities, poses)))


def anny(topology: AnnyTopology, identities: int, poses: int) -> Iterator[NDArray[np.float64]]:
    """Vertices [n, 3] of bodies from babies to old people in poses as the recipes draw them."""
    body = load_body(AnnyBody(topology=topology, phenotypes=PhenotypeRanges(age=(0.0, 1.0))))
    recipe = PoseRecipe(seen=identities * poses, unseen=0, seed=11)
    for identity in range(identities):
        parameters = body.draw_identity(np.random.default_rng(1000 + identity), identity)
        drawn = draw_poses(recipe, np.arange(identity * poses, (identity + 1) * poses))
        yield from body.vertices(parameters, drawn).astype(np.float64)


def report_found(understand: Understanding, meshes: list[NDArray[np.floating]]) -> None:
    """Degrees by which bodies are from upright after their axes were found, and as they are read: after their lean was,
    too, which is given back to what is posed.
    """
    random = np.random.default_rng(0)
    kinds: dict[str, Callable[[], Rotation]] = {
        "upright": Rotation.identity,
        "about the vertical by any angle": lambda: Rotation.from_euler("y", random.uniform(0, 2 * np.pi)),
        "lying, by any angle": lambda: Rotation.from_euler("yx", [random.uniform(0, 2 * np.pi), np.pi / 2]),
        "any rotation": lambda: Rotation.random(random_state=int(random.integers(2**31))),
        "leaning by 30 degrees": lambda: Rotation.from_rotvec(np.radians(30) * sideways(random)),
    }
    for kind, draw in kinds.items():
        left, as_read = list[float](), list[float]()
        for mesh in meshes:
            turn = draw()
            stands = standing(understand, turn.apply(mesh))
            lean = Rotation.from_matrix(facing(understand, stands.turned(turn.apply(mesh)), np.eye(3)))
            found = Rotation.from_matrix(stands.matrix) * turn
            left.append(np.degrees(found.magnitude()))
            as_read.append(np.degrees((lean.inv() * found).magnitude()))
        print(f"{len(meshes[0]):,} vertices, {kind}: {told(left)}; as read {told(as_read)}", flush=True)


def told(degrees: list[float]) -> str:
    """Angles in words."""
    far = int(np.sum(np.array(degrees) > 15))
    return (
        f"{np.median(degrees):.1f} degrees left (median), {max(degrees):.1f} at most, {far} of {len(degrees)} beyond 15"
    )


def sideways(random: np.random.Generator) -> NDArray[np.float64]:
    """A horizontal direction [3]."""
    angle = random.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), 0.0, np.sin(angle)])


if __name__ == "__main__":
    main()
