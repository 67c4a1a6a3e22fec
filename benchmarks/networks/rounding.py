"""How far bfloat16 moves a network's outputs: ``python -m benchmarks.networks.rounding RUN DATA.zarr [--triples 64]``.

PMD between the outputs in bfloat16 and in float32, for unseen poses of new identities of a dataset (in the box of each
mesh, see :func:`training.objectives.metrics.point_mesh_distance`), beside their PMD from the truth. The aim is a mean
of 1e-6.
"""

import argparse
from pathlib import Path

import torch

from datagen.store import open_dataset
from training.data.batch import read_batch
from training.inference.predict import load_trained
from training.networks.execution import precision
from training.objectives.metrics import point_mesh_distance


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("data")
    parser.add_argument("--triples", type=int, default=64)
    options = parser.parse_args()
    network, _, step = load_trained(options.run)
    dataset = open_dataset(options.data)
    batch = read_batch(dataset, dataset.evaluation_triples("unseen")[: options.triples])
    outputs = {}
    for how in ("float32", "bfloat16"):
        with torch.no_grad(), precision(how, torch.device("cpu")):
            parts = [batch.part(start, start + 8) for start in range(0, len(batch), 8)]
            outputs[how] = torch.cat([network(source=part.source, target=part.target) for part in parts])
    apart = point_mesh_distance(outputs["bfloat16"], outputs["float32"])
    truth = {how: float(point_mesh_distance(output, batch.truth).mean()) for how, output in outputs.items()}
    print(f"{options.run}, step {step:,}, {len(batch)} unseen triples of {options.data}")
    print(f"  PMD bfloat16 to float32   mean {float(apart.mean()):.2e}, largest {float(apart.max()):.2e}")
    print("  " + "   ".join(f"PMD {how} to truth {pmd:.3e}" for how, pmd in truth.items()))


if __name__ == "__main__":
    main()
