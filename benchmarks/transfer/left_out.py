"""Transfers of a kind of animal that no training saw: ``python -m benchmarks.transfer.left_out RUN DATASET alpaca``.

A hundred transfers each between new draws of proportions in unseen poses: onto the kind from all others, from it onto
them, between its own draws, and between the others. PMD, medians in brackets, beside that of targets as they are. A
minute.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from datagen.store import Dataset, open_dataset
from training.evaluation.measure import transfer_each
from training.evaluation.robustness import Case, case_of
from training.inference.mesh_reading import normalised
from training.inference.predict import load_trained
from training.objectives import PMD_UNIT

_TRANSFERS = 100


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a run that was trained without the kind")
    parser.add_argument("dataset", help="of all kinds, the recipe 'animals'")
    parser.add_argument("kind", help="a name as in the dataset's body: alpaca, fox")
    options = parser.parse_args()
    dataset, network = open_dataset(options.dataset), load_trained(options.run)[0].eval()
    names = [asset["name"].removesuffix(".glb") for asset in dataset.attributes["body"].get("assets", [])]
    if options.kind not in names:
        parser.error(f"{options.dataset} has no {options.kind!r}, but {', '.join(names) or 'bodies without kinds'}")
    new = dataset.identities("evaluation")
    left = [one for one in new if dataset.parameters(one)[0] == names.index(options.kind)]
    known = [one for one in new if one not in left]
    if min(len(left), len(known), len(dataset.grid.poses("unseen"))) < 2:
        parser.error(f"{options.dataset} needs two new {options.kind}s, two other animals and two unseen poses or more")
    print("| source > target | left out | target unchanged | share |\n|---|---:|---:|---:|")
    random = np.random.default_rng(0)
    for name, sources, targets in (
        (f"others > {options.kind}", known, left),
        (f"{options.kind} > others", left, known),
        (f"{options.kind} > {options.kind}", left, left),
        ("others > others", known, known),
    ):
        found = [drawn(dataset, random, sources, targets, number) for number in range(_TRANSFERS)]
        outputs = transfer_each(network, ((case.source, case.target) for case in found))
        errors = [case.score(output).pmd / PMD_UNIT for case, output in zip(found, outputs, strict=True)]
        kept = [case.score(normalised(case.target.vertices)).pmd / PMD_UNIT for case in found]
        share = np.mean(errors) / np.mean(kept)
        print(f"| {name} | {np.mean(errors):.1f} ({np.median(errors):.1f}) | {np.mean(kept):.0f} | {share:.2f} |")


def drawn(dataset: Dataset, random: np.random.Generator, sources: list[int], targets: list[int], number: int) -> Case:
    """A transfer from one of the sources onto another of the targets, in two unseen poses."""
    source = int(random.choice(sources))
    target = int(random.choice([one for one in targets if one != source]))
    unseen = random.choice(dataset.grid.poses("unseen"), 2, replace=False)
    return case_of(dataset, number, (source, int(unseen[0]), target, int(unseen[1])))


if __name__ == "__main__":
    main()
