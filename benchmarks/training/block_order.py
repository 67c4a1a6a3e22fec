"""What an order of triples in blocks of shards costs in PMD, against full shuffling at equal steps.

python -m benchmarks.training.block_order FOLDER [--seeds 3] [--blocks 930kB 470kB]
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from datagen.generate import generate
from datagen.recipe import DatasetRecipe
from training.engine.trainer import train
from training.recipes.training import TrainingRecipe
from training.tracking.journal import read_journal

DATA = DatasetRecipe.model_validate(
    {
        "body": {"family": "leg", "rings": 12, "segments": 8},
        "identities": {"training": 16, "evaluation": 8},
        "poses": {"seen": 400, "unseen": 100},
        "triples": {"count": 200},
        "store": {"poses_per_shard": 25},
    }
)
TRAINING = TrainingRecipe.model_validate(
    {
        "network": {"encoder_widths": [16, 32, 64], "decoder_widths": [16, 64, 16]},
        "batch": 8,
        "steps": 800,
        "learning_rate": 0.003,
        "schedule": {"name": "one_cycle"},
        "gradient_clip": 1.0,
        "launcher": "inline",
        "device": "cpu",
        "log_every": 100,
        "evaluate_every": 800,
        "evaluate_triples": 200,
        "checkpoint_every": 800,
    }
)


def trained(data: str, run: Path, block: str | None, seed: int) -> tuple[float, float]:
    """PMD x 1e-4 on seen and on unseen poses, after the last step; a run that was finished before is read."""
    recipe = TrainingRecipe.model_validate({**TRAINING.model_dump(), "block": block, "seed": seed})
    train(recipe, data=data, run=run)
    last = read_journal(run / "metrics.jsonl")[-1]
    return 1e4 * last["evaluation/pmd_seen"], 1e4 * last["evaluation/pmd_unseen"]


def main() -> None:
    """Train each order with each seed, and print a row of each."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("folder", type=Path)
    made.add_argument("--seeds", type=int, default=3)
    made.add_argument("--blocks", nargs="*", default=["930kB", "470kB"])
    options = made.parse_args()
    torch.set_num_threads(1)
    dataset = generate(DATA, str(options.folder / "legs.zarr"))
    print(f"all training meshes: {12 * 96 * 16 * 400 / 1e6:.1f} MB", flush=True)
    for block in [None, *options.blocks]:
        runs = (options.folder / f"{block or 'shuffled'}-{seed}" for seed in range(options.seeds))
        found = np.array([trained(dataset.url, run, block, seed) for seed, run in enumerate(runs)])
        values = "; ".join(f"{seen:.2f}, {unseen:.2f}" for seen, unseen in found)
        mean, spread = found.mean(axis=0), np.ptp(found, axis=0)
        print(
            f"{block or 'shuffled'}: PMD x1e-4 seen, unseen of each seed {values}; "
            f"mean {mean[0]:.2f}, {mean[1]:.2f}, spread {spread[0]:.2f}, {spread[1]:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
