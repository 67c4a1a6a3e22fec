"""By how many degrees weights err that find how a mesh stands: ``python -m benchmarks.transfer.standing human``.

Anny bodies that the weights have not seen, of several vertex layouts, in NPT's poses and over the whole range of
motion, turned in several ways; then what that comes to in transfers between forty pairs of them in NPT's poses; then
which of three people in everyday poses are not found to stand as they do. Set OMP_NUM_THREADS=1 on a busy machine.
Twenty CPU minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.transfer.everyday import PEOPLE, POSES, Person
from datagen.bodies import load_body
from datagen.mesh.geometry import Mesh, bounding_box
from datagen.poses import draw_poses
from datagen.recipe import AnatomicalPoses, AnnyBody, AnnyTopology, NptPoses, PhenotypeRanges, PoseRecipe
from training.inference.predict import load_trained
from training.inference.standing import facing, stands, understanding_of
from training.inference.transfer import PoseTransfer
from training.networks.parts import Parts
from training.objectives import PMD_UNIT
from workflows.pretrained import weights_named


class Bodies(NamedTuple):
    """Bodies of one vertex layout, their poses a body, and what these are drawn from."""

    topology: AnnyTopology
    identities: int
    poses: int
    distribution: NptPoses | AnatomicalPoses = NptPoses()


BODIES = (
    Bodies("notoes_collapse5pc", 20, 3), Bodies("notoes_collapse3pc", 10, 2), Bodies("notoes_collapse10pc", 10, 2),
    Bodies("anny", 10, 2), Bodies("notoes_collapse5pc", 20, 3, AnatomicalPoses()),
)  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="a run, or weights that come along, of a network that finds how meshes stand")
    network = load_trained(weights_named(parser.parse_args().weights))[0]
    if not isinstance(network, Parts):
        parser.error("these weights are of a network that does not find how meshes stand")
    for bodies in BODIES:
        report_found(network, bodies)
    report_transfers(PoseTransfer(network), list(pairs(40)))
    report_everyday(network)


def anny(bodies: Bodies) -> Iterator[Mesh]:
    """Bodies from babies to old people, each in poses of its own."""
    body = load_body(AnnyBody(topology=bodies.topology, phenotypes=PhenotypeRanges(age=(0.0, 1.0))))
    recipe = PoseRecipe(seen=bodies.identities * bodies.poses, unseen=0, seed=1011, distribution=bodies.distribution)
    for identity in range(bodies.identities):
        parameters = body.draw_identity(np.random.default_rng(1000 + identity), identity)
        drawn = draw_poses(recipe, np.arange(bodies.poses) + identity * bodies.poses)
        for vertices in body.vertices(parameters, drawn):
            yield Mesh(vertices.astype(np.float64), body.faces(parameters))


def report_found(network: Parts, bodies: Bodies) -> None:
    """Degrees by which bodies are from upright after their axes were found, and as they are read: after their lean was,
    too, which is given back to what is posed.
    """
    random, meshes = np.random.default_rng(0), list(anny(bodies))
    print(f"{len(meshes[0].vertices):,} vertices, poses {bodies.distribution.name}:")
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
            for degrees, found in zip((left, as_read), degrees_off(network, mesh, turn), strict=True):
                degrees.append(found)
        print(f"  {kind}: {told(left)}; as read {told(as_read)}", flush=True)


def degrees_off(network: Parts, mesh: Mesh, turn: Rotation) -> tuple[float, float]:
    """Degrees by which a body that was turned is from upright after its axes were found, and as it is read."""
    turned = Mesh(turn.apply(mesh.vertices), mesh.faces)
    stood = stands(network, turned)
    lean = Rotation.from_matrix(facing(understanding_of(network), stood.turned(turned.vertices), stood))
    found = Rotation.from_matrix(stood.matrix) * turn
    return float(np.degrees(found.magnitude())), float(np.degrees((lean.inv() * found).magnitude()))


def told(degrees: list[float]) -> str:
    """Angles in words."""
    far = int(np.sum(np.array(degrees) > 15))
    return (
        f"{np.median(degrees):.1f} degrees left (median), {max(degrees):.1f} at most, {far} of {len(degrees)} beyond 15"
    )


class Pair(NamedTuple):
    """Two people of one topology: vertices of the source, the target, and the target in the source's pose [n, 3]."""

    source: NDArray[np.float64]
    target: NDArray[np.float64]
    truth: NDArray[np.float64]
    faces: NDArray[np.integer]


def pairs(count: int) -> Iterator[Pair]:
    """Pairs of people of all ages, of 615 vertices."""
    body = load_body(AnnyBody(topology="notoes_collapse5pc", phenotypes=PhenotypeRanges(age=(0.0, 1.0))))
    recipe = PoseRecipe(seen=2 * count, unseen=0, seed=1012)
    for number in range(count):
        people = [body.draw_identity(np.random.default_rng(2000 + 2 * number + who), who) for who in (0, 1)]
        poses = draw_poses(recipe, [2 * number, 2 * number + 1])
        source, (truth, target) = body.vertices(people[0], poses)[0], body.vertices(people[1], poses)
        yield Pair(*(each.astype(np.float64) for each in (source, target, truth)), body.faces(people[1]))


def report_transfers(transfer: PoseTransfer, bodies: list[Pair]) -> None:
    """PMD of transfers from and onto bodies that are turned, and of what is left without the best turn and scale."""
    random = np.random.default_rng(1)
    still = Rotation.identity

    def leaning(degrees: float) -> Callable[[], Rotation]:
        return lambda: Rotation.from_rotvec(np.radians(degrees) * sideways(random))

    kinds: dict[str, tuple[Callable[[], Rotation], Callable[[], Rotation]]] = {
        "as it is": (still, still),
        "leaning by 15 degrees": (leaning(15), still),
        "leaning by 30 degrees": (leaning(30), still),
        "leaning by 45 degrees": (leaning(45), still),
        "the target leaning by 30 degrees": (still, leaning(30)),
        "about the vertical by any angle": (lambda: Rotation.from_euler("y", random.uniform(0, 2 * np.pi)), still),
        "any rotation": (lambda: Rotation.random(random_state=int(random.integers(2**31))), still),
    }
    print("| source | PMD x1e-4 | the best turn and scale taken out |\n|---|---:|---:|")
    for kind, (of_source, of_target) in kinds.items():
        errors = list[tuple[float, float]]()
        for pair in bodies:
            turn = of_source()
            source, target = Mesh(turn.apply(pair.source), pair.faces), Mesh(of_target().apply(pair.target), pair.faces)
            output = boxed(transfer(source=source, target=target).vertices)
            errors.append((pmd(output, boxed(turn.apply(pair.truth))), pmd(*aligned(output, boxed(pair.truth)))))
        means, medians = np.mean(errors, axis=0), np.median(errors, axis=0)
        cells = [f"{mean:.2f} ({median:.2f})" for mean, median in zip(means, medians, strict=True)]
        print(f"| {kind} | {' | '.join(cells)} |", flush=True)


def report_everyday(network: Parts) -> None:
    """People in everyday poses, as they are, from behind and lying, who are read more than 20 degrees off."""
    ways = {"as it is": ("y", 0), "from behind": ("y", 180), "on the back": ("x", -90), "on the side": ("z", 90)}
    far, count = 0, len(POSES) * len(PEOPLE) * len(ways)
    for who, person in PEOPLE.items():
        body = Person(*person)
        for pose in POSES:
            for way, turn in ways.items():
                off = degrees_off(network, body(pose), Rotation.from_euler(*turn, degrees=True))[1]
                if off > 20:
                    far += 1
                    print(f"{who}, {pose}, {way}: {off:.0f} degrees", flush=True)
    print(f"{far} of {count} in everyday poses are read more than 20 degrees off")


def boxed(vertices: NDArray[np.floating]) -> NDArray[np.float64]:
    """Vertices [n, 3] in their normalised box."""
    return bounding_box(vertices).normalise(vertices)


def aligned(one: NDArray[np.float64], other: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vertices [n, 3] turned, scaled and moved to where they are nearest to the others [n, 3], and these, centred."""
    one, other = one - one.mean(axis=0), other - other.mean(axis=0)
    turned = Rotation.align_vectors(other, one)[0].apply(one)
    return turned * (turned * other).sum() / np.square(turned).sum(), other


def pmd(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """PMD of vertices [n, 3] in the units of tables."""
    return float(np.square(one - other).mean()) / PMD_UNIT


def sideways(random: np.random.Generator) -> NDArray[np.float64]:
    """A horizontal direction [3]."""
    angle = random.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), 0.0, np.sin(angle)])


if __name__ == "__main__":
    main()
