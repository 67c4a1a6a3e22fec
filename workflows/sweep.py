"""Many trainings on one dataset, as Ray tasks, and which of them learned best; one MLflow run a trial.

    python workflows/sweep.py --vary training.learning_rate=0.001,0.002,0.004 --out runs/sweep
    python workflows/sweep.py --vary training.learning_rate=0.001,0.002 training.network.initial_mixing=0,0.5
    python workflows/sweep.py --trials networks --cpus-per-trial 2
    python workflows/sweep.py --trials mine.yaml --recipe smoke --set training.steps=100
    ray job submit --working-dir . -- python workflows/sweep.py --trials optimisation --out /data/runs/optimisation

The grid of all --vary values, or the trials of a file, or every trial of the file in every combination of the grid.
Run the same command again to go on from where it was: finished trials are skipped, failed ones are tried again.
OUT/trials/NAME is an ordinary run folder; OUT/sweep.md, sweep.csv and figures/sweep.png compare them.
"""

import sys
from pathlib import Path

_ROOT = str(Path(__file__).resolve().parents[1])


def main(arguments: list[str] | None = None) -> None:
    """Parse, then sweep."""
    from workflows.console import parser
    from workflows.sweep_command import add_sweep_options, sweep_command

    made = parser(__doc__ or "")
    add_sweep_options(made)
    sweep_command(made.parse_args(arguments))


if __name__ == "__main__":
    if sys.path[0] != _ROOT:  # a script's own folder comes first otherwise, and its files would hide packages
        sys.path[0] = _ROOT
    from workflows.console import guarded

    guarded(main)
