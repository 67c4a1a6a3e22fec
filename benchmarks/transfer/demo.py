"""CPU time from a click on the page of ``dsffnet demo`` to its result: ``python -m benchmarks.transfer.demo``.

Counted is what the server does: bodies made, written and read, the pose given, the truth measured; neither the way to
the browser nor its drawing. Every time the source has another pose. CPU seconds are the process' own (user and system),
one thread, the least of nine; other work on a machine lengthens them less than the clock's, which stand beside them.
"""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from datagen.characters import cc0_animals
from datagen.mesh.files import save_mesh
from datagen.mesh.geometry import Mesh
from workflows.demo.bodies import Figure, mesh_of, random_figure
from workflows.demo.poses import ANIMAL, PERSON, Pose
from workflows.demo.transfers import Asked, Body, Outcome, Switches, Transfers

_TIMES, _OWN = 9, 6_890


def main() -> None:
    """Print a table."""
    torch.set_num_threads(1)
    transfers = Transfers(None)
    print("| from click to result | vertices | CPU s | s |\n|---|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        for name, asked in cases(Path(folder)):
            cpu, clock, count = least(transfers, asked, Path(folder))
            print(f"| {name} | {count:,} | {cpu:.2f} | {clock:.2f} |", flush=True)


def cases(folder: Path) -> Iterator[tuple[str, list[Asked]]]:
    """What is clicked, as often as it is timed and once before."""
    random = np.random.default_rng(0)
    person = random_figure(PERSON, random)
    sources = [replace(person, pose=Pose(float(pose))) for pose in range(1, _TIMES + 2)]
    small = [replace(source, topology="notoes_collapse5pc") for source in sources]
    yield "made-up people", asked_of(small, replace(small[0], parameters=random_figure(PERSON, random).parameters))
    bare = random_figure(PERSON, random)
    yield "made-up people", asked_of(sources, bare)
    coat = replace(bare, outfit="coat", pose=Pose())
    yield "a person in a coat", asked_of(sources, coat)
    yield "the same, with the error map", [replace(each, draped=True) for each in asked_of(sources, coat)]
    own = [(own_mesh(figure, folder / f"{number}.obj"),) for number, figure in enumerate([*sources, bare])]
    yield "own meshes", asked_of(own[:-1], own[-1])
    yield "the same, refined", [replace(each, switches=Switches(refine=True)) for each in asked_of(own[:-1], own[-1])]
    if cc0_animals.are_there():
        animal = random_figure(ANIMAL, random)
        poses = [replace(animal, pose=source.pose) for source in sources]
        yield "made-up animals", asked_of(poses, random_figure(ANIMAL, random))


def asked_of(sources: list[Figure] | list[tuple[Path, ...]], target: Body) -> list[Asked]:
    """Every source on one target."""
    return [Asked(source, target) for source in sources]


def own_mesh(figure: Figure, path: Path) -> Path:
    """The figure as a file of 6,890 vertices, as many as SMPL has."""
    import fast_simplification

    mesh = mesh_of(figure)
    vertices, faces = fast_simplification.simplify(mesh.vertices, mesh.faces.astype(np.int32), target_count=2 * _OWN)
    save_mesh(Mesh(vertices, faces), path)
    return path


def least(transfers: Transfers, asked: list[Asked], folder: Path) -> tuple[float, float, int]:
    """Least CPU and clock seconds of a click, the first left out, and the vertices of the target."""
    taken, outcomes = list[tuple[float, float]](), list[Outcome]()
    for each in asked:
        cpu, clock = time.process_time(), time.perf_counter()
        transfers.run(each, folder / "session", lambda: False, outcomes.append)
        taken.append((time.process_time() - cpu, time.perf_counter() - clock))
    counts, clocks = zip(*taken[1:], strict=True)
    return min(counts), min(clocks), len(outcomes[-1].file.mesh.vertices)


if __name__ == "__main__":
    main()
