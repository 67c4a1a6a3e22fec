"""What it costs that meshes are not sampled alike: ``python -m benchmarks.transfer.samplings human COARSE FINE``.

The same people in the same poses as two datasets of one recipe, coarse and fine (docs/results/parts.md). Transfers
within each, where source and target list the same vertices; between both; the same with noise in the source; and from
points of the fine meshes, even by area, onto either. PMD, medians in brackets. 200 triples of the quickstart's people
take twenty minutes of one core.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from datagen.store import open_dataset
from training.evaluation.disturbances import add_noise, resample_by_area
from training.evaluation.measure import transfer_each
from training.evaluation.robustness import Case, case_of, first_triples
from training.inference.predict import load_trained
from training.objectives import PMD_UNIT
from workflows.pretrained import weights_named

_NOISE = (0.01, 0.02, 0.04)
"""Standard deviations, half the longest box edge being 1."""
_POINTS = (615, 1230, 2460, 4920, 13718)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="a run, or weights that come along")
    parser.add_argument("coarse", help="a dataset with evaluation triples")
    parser.add_argument("fine", help="one of the same recipe but for the topology")
    parser.add_argument("--triples", type=int, default=200)
    options = parser.parse_args()
    network = load_trained(weights_named(options.weights))[0].eval()
    coarse, fine = open_dataset(options.coarse), open_dataset(options.fine)
    triples = first_triples(coarse, options.triples, advice="Name one that has").tolist()
    if not np.array_equal(triples, first_triples(fine, options.triples, advice="Name one that has")):
        parser.error(f"{options.coarse} and {options.fine} have other triples: make both by one recipe")

    def row(name: str, cases: Sequence[Case]) -> None:
        outputs = transfer_each(network, ((case.source, case.target) for case in cases))
        errors = [case.score(output).pmd / PMD_UNIT for case, output in zip(cases, outputs, strict=True)]
        print(f"| {name} | {np.mean(errors):.2f} ({np.median(errors):.2f}) | {max(errors):.1f} |", flush=True)

    print("| source > target | PMD x1e-4 | at most |\n|---|---:|---:|")
    pairs = {
        (one, other): [case_of(source, number, triple, target) for number, triple in enumerate(triples)]
        for one, source in (("coarse", coarse), ("fine", fine))
        for other, target in (("coarse", coarse), ("fine", fine))
    }
    for (one, other), cases in pairs.items():
        row(f"{one} > {other}", cases)
    for noise in _NOISE:
        for (one, other), cases in pairs.items():
            row(f"{one}, noise of {noise} > {other}", [with_noise(case, noise) for case in cases])
    for count in _POINTS:
        for other in ("coarse", "fine"):
            row(f"{count:,} points > {other}", [as_points(case, count) for case in pairs["fine", other]])


def with_noise(case: Case, deviation: float) -> Case:
    """A transfer from its source with noise, the same each time."""
    return replace(case, source=add_noise(case.source, deviation, case.number))


def as_points(case: Case, count: int) -> Case:
    """A transfer from so many points of the surface of its source, the same each time."""
    source = resample_by_area(case.source, count / len(case.source.vertices), case.number)
    return replace(case, source=source)


if __name__ == "__main__":
    main()
