"""DSFFNet and its ablations under one budget on one dataset: the paper's Table 3 and its figure.

    python workflows/ablation.py                                  # the recipe 'small': 6 minutes on two cores
    python workflows/ablation.py --recipe animals-small --out /tmp/animals
    python workflows/ablation.py --recipe paper --gpus-per-trial 1
    python workflows/ablation.py --set training.steps=500 --out runs/quick
    ray job submit --working-dir . -- python workflows/ablation.py --recipe paper --gpus-per-trial 1 --out /data/X

Run the same command again to go on from where it was: what is finished is skipped, what failed is tried again.
OUT/report.html is the result; OUT/trials/METHOD are ordinary run folders.
"""

import sys
from pathlib import Path

_ROOT = str(Path(__file__).resolve().parents[1])


def main(arguments: list[str] | None = None) -> None:
    """Parse, then take parts away."""
    from workflows.comparison_command import ablation_command, add_comparison_options
    from workflows.console import parser

    made = parser(__doc__ or "")
    add_comparison_options(made, "ablation")
    ablation_command(made.parse_args(arguments))


if __name__ == "__main__":
    if sys.path[0] != _ROOT:  # a script's own folder comes first otherwise, and its files would hide packages
        sys.path[0] = _ROOT
    from workflows.console import guarded

    guarded(main)
