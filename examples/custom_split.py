"""A custom split: does a network that saw more people pose strangers better? Two datasets, two trainings, one table.

    python examples/custom_split.py                                        # people of Anny; minutes on two cores
    python examples/custom_split.py --recipe smoke --steps 60 --out /tmp/split    # procedural legs; a minute

Sixty steps are too few to tell one split from another.

Run it again to resume: datasets that are complete and steps that were trained are not made again.
"""

import argparse
from pathlib import Path

from datagen.common.errors import DsffnetError
from datagen.generate import generate
from training.evaluation.evaluate import read_rows
from training.evaluation.tables import mean_of
from workflows.pipeline.evaluate import evaluate_weights
from workflows.pipeline.generate import generation_bar
from workflows.pipeline.run_folder import EvaluationFolder, RunFolder
from workflows.pipeline.tasks import TaskRunner
from workflows.pipeline.train import train_model
from workflows.recipe.loader import WorkflowRecipe, load_recipe

SPLITS = {
    # the same seed: the four people are the first four of the sixteen
    "four": ["data.identities.seed=7", "data.identities.training=4"],
    "sixteen": ["data.identities.seed=7", "data.identities.training=16"],
    # another seed: nobody of these was in either
    "strangers": ["data.identities.seed=8", "data.identities.training=1", "data.identities.evaluation=8"],
}


def recipes(name: str, steps: int) -> dict[str, WorkflowRecipe]:
    """A recipe a split. Any key of one can be set, as on the command line (``dsffnet recipe`` prints them all)."""
    small = ["data.poses.seen=200", "data.poses.unseen=40", f"training.steps={steps}", "beside=null"]
    return {split: load_recipe(name, [*small, *changes]) for split, changes in SPLITS.items()}


def main() -> None:
    """Generate, train, evaluate, compare."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--recipe", default="quickstart", help="that the splits change (default: %(default)s)")
    made.add_argument("--steps", type=int, default=600, help="of each training (default: %(default)s)")
    made.add_argument("--out", type=Path, default=Path("runs/custom-split"), help="folder (default: %(default)s)")
    options = made.parse_args()
    all_recipes, tasks = recipes(options.recipe, options.steps), TaskRunner(local=True)

    for split, recipe in all_recipes.items():
        print(f"== data: {split}", flush=True)
        generate(recipe.data, str(options.out / f"{split}.zarr"), progress=generation_bar)

    strangers, scores = str(options.out / "strangers.zarr"), {}
    for split in ("four", "sixteen"):
        recipe, run = all_recipes[split], RunFolder(options.out / split)
        print(f"== training on {split}, then strangers", flush=True)
        train_model(recipe.training, str(options.out / f"{split}.zarr"), run, parent=None, tasks=tasks)
        evaluate_weights(recipe.evaluation, strangers, run.path, parent=None, tasks=tasks)
        rows = read_rows(EvaluationFolder(run.path / "evaluation-strangers").rows)
        scores[split] = {
            method: 1e4 * mean_of(rows, method=method, pose_type="unseen", field="pmd")
            for method in ("DSFFNet", "target unchanged")
        }

    print("\nPMD x1e-4 of strangers in unseen poses, lower is better")
    print(f"{'trained on':12}{'DSFFNet':>10}{'target unchanged':>20}")
    for split, found in scores.items():
        print(f"{split:12}{found['DSFFNet']:10.2f}{found['target unchanged']:20.2f}")


if __name__ == "__main__":
    try:
        main()
    except DsffnetError as error:
        raise SystemExit(f"error: {error}") from error
