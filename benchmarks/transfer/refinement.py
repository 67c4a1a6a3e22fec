"""What refinement is worth: ``python -m benchmarks.transfer.refinement RUN DATA [--triples 100]``.

By weight, over the dataset's unseen evaluation triples, whose truth is known.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from datagen.mesh.geometry import Mesh, bounding_box, edges_of
from datagen.store import Dataset, open_dataset
from training.inference.refinement import Refinement
from training.inference.transfer import PoseTransfer, scale_of
from training.objectives import metrics

WEIGHTS = (0.0, 0.5, 2.0, 6.0, 20.0, 60.0)


def main() -> None:
    """Measure and print both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("data")
    parser.add_argument("--triples", type=int, default=100)
    options = parser.parse_args()
    transfer, dataset = PoseTransfer.from_run(options.run), open_dataset(options.data)
    triples = dataset.evaluation_triples("unseen")[: options.triples].tolist()
    print(f"refinement, {len(triples)} unseen triples\n| weight | PMD x1e-4 | edge error | normal error, degrees |")
    rows = np.array([refined(transfer, dataset, triple) for triple in triples]).mean(axis=0)
    for weight, (pmd, edge, normal) in zip(WEIGHTS, rows, strict=True):
        print(f"| {weight:g} | {pmd * 1e4:.1f} | {edge:.3f} | {normal:.1f} |")


def refined(transfer: PoseTransfer, dataset: Dataset, triple: list[int]) -> list[tuple[float, float, float]]:
    """PMD, edge and normal error of one triple for each weight."""
    source_identity, source_pose, target_identity, target_pose = triple
    faces, truth = dataset.faces(target_identity), dataset.vertices(target_identity, source_pose).astype(np.float64)
    target = Mesh(dataset.vertices(target_identity, target_pose).astype(np.float64), faces)
    source = Mesh(dataset.vertices(source_identity, source_pose).astype(np.float64), dataset.faces(source_identity))
    output = transfer.unplaced(source, target)
    scale, right = scale_of(target, output), torch.from_numpy(bounding_box(truth).normalise(truth))[None]
    edges, triangles = torch.from_numpy(edges_of(faces)), torch.from_numpy(faces).long()
    found = []
    for weight in WEIGHTS:
        ours = torch.from_numpy(Refinement(target, weight=weight)(output * scale) / scale)[None]
        pmd = float(metrics.point_mesh_distance(ours, right))
        edge = float(metrics.edge_length_ratio_error(ours, right, edges))
        found.append((pmd, edge, float(metrics.normal_angle_error(ours, right, triangles))))
    return found


if __name__ == "__main__":
    main()
