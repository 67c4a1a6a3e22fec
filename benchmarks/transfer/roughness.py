"""How rough clean meshes are, and noisy ones: ``python -m benchmarks.transfer.roughness COARSE FINE [ANIMALS]``.

The roughness by which a mesh is read through a low-pass filter or not (:meth:`datagen.mesh.low_pass.LowPass.roughness`)
of the sources of datasets' evaluation triples, as they are, subdivided, clustered and simplified, without and with
noise: least and greatest (docs/results/parts-experiments.md). A minute.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import fast_simplification
import numpy as np

from datagen.mesh.geometry import Mesh, bounding_box
from datagen.mesh.low_pass import LowPass
from datagen.store import Dataset, open_dataset
from training.evaluation.disturbances import add_noise, merge_cells, subdivide
from training.evaluation.robustness import case_of, first_triples

_NOISE = (0.0, 0.005, 0.01, 0.02)
_SIMPLIFIED = (6863, 2749, 1104, 693)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("coarse", help="a dataset with evaluation triples")
    parser.add_argument("fine", help="one of finer meshes, which are simplified, too")
    parser.add_argument("others", nargs="*", help="more, measured as they are")
    parser.add_argument("--meshes", type=int, default=24)
    options = parser.parse_args()
    coarse, fine, *others = (
        sources(open_dataset(url), options.meshes) for url in (options.coarse, options.fine, *options.others)
    )
    print(
        f"| meshes | {' | '.join(f'noise of {noise}' if noise else 'clean' for noise in _NOISE)} | clean differences |"
    )
    print(f"|---|{'---:|' * (len(_NOISE) + 1)}")
    row("coarse", coarse)
    row("coarse, subdivided twice", [subdivide(mesh, 2, 0) for mesh in coarse])
    row("coarse, clustered to cells of 0.1", [merge_cells(mesh, 0.1, 0) for mesh in coarse])
    row("fine", fine)
    for count in _SIMPLIFIED:
        row(f"fine, simplified to {count:,}", [simplified(mesh, count) for mesh in fine])
    for url, meshes in zip(options.others, others, strict=True):
        row(url, meshes)


def sources(dataset: Dataset, count: int) -> list[Mesh]:
    """The sources of the first evaluation triples."""
    triples = first_triples(dataset, count, advice="Name one that has").tolist()
    return [case_of(dataset, number, triple, dataset).source for number, triple in enumerate(triples)]


def simplified(mesh: Mesh, count: int) -> Mesh:
    """A mesh of some ``count`` vertices with nearly the surface of another."""
    share = 1 - count / len(mesh.vertices)
    vertices, faces = fast_simplification.simplify(
        np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32), share
    )
    return Mesh(vertices.astype(np.float64), faces.astype(np.int64))


def row(name: str, meshes: Sequence[Mesh]) -> None:
    """Print one line of the table; differences are relative to half the longest box edge."""
    cells, differences = list[str](), list[float]()
    for noise in _NOISE:
        rough = [add_noise(mesh, noise, number) if noise else mesh for number, mesh in enumerate(meshes)]
        found = [LowPass(mesh.faces, len(mesh.vertices)).roughness(mesh.vertices) for mesh in rough]
        cells.append(span([value for value, _ in found]))
        if not noise:
            differences = [
                each / bounding_box(mesh.vertices).half for (_, each), mesh in zip(found, rough, strict=True)
            ]
    print(f"| {name} | {' | '.join(cells)} | {span(differences, digits=4)} |", flush=True)


def span(values: Sequence[float], *, digits: int = 2) -> str:
    """Least to greatest."""
    return f"{min(values):.{digits}f} to {max(values):.{digits}f}"


if __name__ == "__main__":
    main()
